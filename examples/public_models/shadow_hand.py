"""Position servos: the Shadow hand of Gymnasium-Robotics curls its index finger; the tip has to come to within 1 cm."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("gymnasium_robotics") or exit("pip install gymnasium-robotics")
_GOAL = np.zeros(24)
_GOAL[[3, 4]] = 0.8  # FFJ2, FFJ1

ShadowHand = task_from_mujoco(
    Path(_PACKAGE.origin).parent / "envs/assets/hand/reach.xml",
    point="robot0:S_fftip",
    goal_state=_GOAL,
    goal_radius=0.01,
    horizon=200,
    training={"policy.action_repeat": 10},
)
