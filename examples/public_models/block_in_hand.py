"""A free object: a block has to come back to where it lies in the palm of Gymnasium-Robotics' Shadow hand."""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("gymnasium_robotics") or exit("pip install gymnasium-robotics")
_SPEC = mujoco.MjSpec.from_file(str(Path(_PACKAGE.origin).parent / "envs/assets/hand/manipulate_block.xml"))
_SPEC.delete(_SPEC.body("target"))  # a second block, which the environment holds in the air to show the goal

#: The hand open, the block where it comes to rest in it; the wrist gives under their weight.
_GOAL = np.zeros(31)
_GOAL[1] = -0.0974
_GOAL[24:] = [0.9986, 0.8589, 0.166, 0.9981, 0.0604, -0.0008, 0.013]
_GOAL[27:] /= np.linalg.norm(_GOAL[27:])

BlockInHand = task_from_mujoco(
    _SPEC,
    point="object",
    goal_state=_GOAL,
    goal_radius=0.01,
    feasible_radius=0.1,  # not on the floor
    horizon=200,
    training={"policy.action_repeat": 10},
)
