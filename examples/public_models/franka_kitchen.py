"""Meshes, equality constraints: the Franka arm of Gymnasium-Robotics' kitchen brings its hand back to a point."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("gymnasium_robotics") or exit("pip install gymnasium-robotics")

#: Where the environment begins: nine joints of the robot, fourteen of the kitchen, the kettle on the stove.
_GOAL = np.zeros(30)
_GOAL[:9] = [0.148, -1.768, 1.844, -2.477, 0.26, 0.713, 1.595, 0.04, 0.037]
_GOAL[23:] = [-0.269, 0.35, 1.6194, 1.0, 0.0, 0.0, 0.0]

FrankaKitchen = task_from_mujoco(
    Path(_PACKAGE.origin).parent / "envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml",
    point="end_effector",
    goal_state=_GOAL,
    goal_radius=0.03,
    horizon=200,
    training={"policy.action_repeat": 10},
)
