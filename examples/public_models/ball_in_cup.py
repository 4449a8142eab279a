"""A tendon: the control suite's ball hangs on a string of 30 cm from the cup that it has to come into."""

from importlib.util import find_spec
from pathlib import Path

from rcg_jax import task_from_mujoco

_PACKAGE = find_spec("dm_control") or exit("pip install dm_control")

BallInCup = task_from_mujoco(
    Path(_PACKAGE.origin).parent / "suite/ball_in_cup.xml",
    point="ball",
    target="target",
    goal_state=[0.0, -0.0641, 0.0, 0.2684],  # the springs of the cup give; the ball lies in it
    goal_radius=0.03,
    horizon=200,
    training={"policy.action_repeat": 10},
)
