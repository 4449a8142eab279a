"""A task from the control suite of MuJoCo Playground: its MJCF, with a goal state. Nothing of it is imported."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from rcg_jax.config.class_path import ENVIRONMENTS
from rcg_jax.config.names import did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.from_gymnasium import points
from rcg_jax.tasks.from_mujoco import finder, point_at, task_from_mujoco

#: Environments by the file of their model, with the physics steps of one of their actions.
_FILES = {
    "acrobot": (1, ("AcrobotSwingup", "AcrobotSwingupSparse")),
    "ball_in_cup": (10, ("BallInCup",)),
    "cartpole": (1, ("CartpoleBalance", "CartpoleBalanceSparse", "CartpoleSwingup", "CartpoleSwingupSparse")),
    "cheetah": (1, ("CheetahRun",)),
    "finger": (4, ("FingerSpin", "FingerTurnEasy", "FingerTurnHard")),
    "fish": (20, ("FishSwim",)),
    "hopper": (4, ("HopperHop", "HopperStand")),
    "humanoid": (5, ("HumanoidStand", "HumanoidWalk", "HumanoidRun")),
    "pendulum": (2, ("PendulumSwingup",)),
    "point_mass": (1, ("PointMass",)),
    "reacher": (4, ("ReacherEasy", "ReacherHard")),
    "walker": (5, ("WalkerRun", "WalkerStand", "WalkerWalk")),
}
_FILE = {env: (file, held) for file, (held, envs) in _FILES.items() for env in envs}

_CARTPOLE = {"point": ("pole_1", (0.0, 0.0, 1.0)), "goal_state": (0.0, 0.0), "goal_radius": 0.1}
_FINGER = {"point": "tip", "target": "target", "goal_state": (-math.pi / 2, 0.0, 0.0), "goal_radius": 0.07}
_REACHER = {"point": "finger", "target": "target", "goal_state": (1.0, 1.0), "goal_radius": 0.06}
_ACROBOT = {"point": "tip", "target": "target", "goal_state": (0.0, 0.0), "goal_radius": 0.2}

#: What has to come where: settings of :func:`task_from_mujoco`. The radii are the environments'; where those reward a
#: posture held for long, the goal is to reach it. Their targets, drawn at random, stay where the goal state has them.
DEFAULTS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        "AcrobotSwingup": _ACROBOT,
        "AcrobotSwingupSparse": _ACROBOT,
        # At rest: the springs of the cup give by 6 cm, the ball lies in it.
        "BallInCup": {
            "point": "ball",
            "target": "target",
            "goal_state": (0.0, -0.0641, 0.0, 0.2684),
            "goal_radius": 0.04,
        },
        "CartpoleBalance": _CARTPOLE,
        "CartpoleBalanceSparse": _CARTPOLE,
        "CartpoleSwingup": _CARTPOLE,
        "CartpoleSwingupSparse": _CARTPOLE,
        "FingerTurnEasy": _FINGER,
        "FingerTurnHard": _FINGER | {"goal_radius": 0.03},
        "PendulumSwingup": {"point": ("pole", (0.0, 0.0, 0.5)), "goal_state": (0.0,), "goal_radius": 0.07},
        "PointMass": {"point": "pointmass", "goal_state": (0.0, 0.0), "goal_radius": 0.015},
        "ReacherEasy": _REACHER,
        "ReacherHard": _REACHER | {"goal_radius": 0.025},
    }
)


def task_from_playground(env: str, **settings: Any) -> type[Task]:
    """A task class from an environment of MuJoCo Playground's control suite: its model, a point and a goal state.

        Reach = task_from_playground("ReacherEasy")
        Turn = task_from_playground("FingerTurnHard", goal_state=[-1.57, 0.0, 2.0])  # the target is elsewhere

    Actions are held for as many physics steps as there; reward, observation and starts are not taken over. The body
    ``target``, which is mocap there, is a fixed one where the point is in the goal state. Only the package's MJCF files
    are read.

    Args:
        env: name of an environment.
        settings: those of :func:`rcg_jax.task_from_mujoco`; ``point`` and ``goal_state`` where :data:`DEFAULTS` does
            not have the environment.

    Raises:
        ConfigError: Playground is not installed, there is no such environment, or what has to come where is missing.
    """
    refuse = f"playground:{env}"
    package = find_spec("mujoco_playground")
    if package is None or package.origin is None:
        raise ConfigError(f"{refuse}: mujoco_playground is not installed: {ENVIRONMENTS['playground'][1]}")
    if env not in _FILE:
        hint = did_you_mean(env, _FILE) or f"must be one of {', '.join(_FILE)}"
        raise ConfigError(
            f"{refuse}: {hint} (the models of robots are downloaded by Playground, the swimmer's is made by a program: "
            f"they are not in its files; rcg_jax.task_from_mujoco takes any MJCF)"
        )
    file, held = _FILE[env]
    path = Path(package.origin).parent / "_src" / "dm_control_suite" / "xmls" / f"{file}.xml"
    if not path.is_file():
        raise ConfigError(f"{refuse}: no such file: {path}; made for playground 0.2")
    spec = mujoco.MjSpec.from_file(str(path))
    given = DEFAULTS.get(env, {}) | settings
    if "point" not in given or "goal_state" not in given:
        model = spec.compile()
        raise ConfigError(
            f"{refuse}: has no goal state (a speed or a posture is rewarded): write a file with Mine = "
            f"rcg_jax.task_from_playground({env!r}, point=..., goal_state=...) and task=file.py:Mine; "
            f"points are {points(model)}; goal_state is {model.nq} positions"
        )
    _place_target(spec, given, refuse)
    training = {"policy.action_repeat": held} | dict(given.pop("training", {}))
    return task_from_mujoco(spec, **{"name": env, **given, "training": training})


def _place_target(spec: mujoco.MjSpec, given: dict[str, Any], refuse: str) -> None:
    """Puts the mocap body that marks the target where the point is in the goal state."""
    marker, model = spec.body("target"), spec.compile()
    goal = given["goal_state"]
    if marker is not None and marker.mocap and np.shape(goal) == (model.nq,):  # else it is refused
        marker.mocap, marker.pos = False, point_at(model, goal, finder(model, "point", given["point"], refuse))
