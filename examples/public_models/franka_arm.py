"""Meshes that collide: the Franka arm of Gymnasium-Robotics' kitchen brings its hand to within 3 cm of a point."""

from importlib.util import find_spec
from pathlib import Path

import mujoco

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("gymnasium_robotics") or exit("pip install gymnasium-robotics")
_FOLDER = Path(_PACKAGE.origin).parent / "envs/assets/kitchen_franka/kitchen_assets"
_SPEC = mujoco.MjSpec.from_file(str(_FOLDER / "kitchen_env_model.xml"))
for _part in (*_SPEC.equalities, *_SPEC.keys, _SPEC.body("desk"), _SPEC.body("kettle")):  # the kitchen
    _SPEC.delete(_part)

FrankaArm = task_from_mujoco(
    _SPEC,
    point="end_effector",
    goal_state=[0.148, -1.768, 1.844, -2.477, 0.26, 0.713, 1.595, 0.04, 0.037],  # where the environment begins
    goal_radius=0.03,
    horizon=200,
    training={"policy.action_repeat": 10},
)
