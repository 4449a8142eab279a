"""Actuator dynamics: the control suite's quadruped, whose servos filter their controls, comes back to a point."""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("dm_control") or exit("pip install dm_control")
_SPEC = mujoco.MjSpec.from_file(str(Path(_PACKAGE.origin).parent / "suite/quadruped.xml"))
_SPEC.delete(_SPEC.body("ball"))  # of another of its tasks

#: It stands at rest, and its legs give.
_LEG = [0.0, -0.1121, -0.0077, 0.119]
_GOAL = np.array([0.0, 0.0, 0.4538, 1.0, 0.0, 0.0, 0.0, *_LEG * 4])

Quadruped = task_from_mujoco(
    _SPEC,
    point="torso",
    goal_state=_GOAL,
    goal_radius=0.05,
    feasible_radius=0.5,
    horizon=200,
    search={"max_depth": 0.003},  # its feet sink into the floor by 1.7 mm
    training={"policy.action_repeat": 4},
)
