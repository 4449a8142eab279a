"""A task from a MuJoCo environment of Gymnasium or Gymnasium-Robotics: its model, with a goal state."""

from __future__ import annotations

import importlib
import re
import warnings
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from rcg_jax.config.class_path import ENVIRONMENTS
from rcg_jax.config.load_class import describe
from rcg_jax.config.names import did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.from_mujoco import listed, moving, task_from_mujoco

#: What has to come where, by an environment's name without its version: settings of :func:`task_from_mujoco`.
DEFAULTS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        # 0.1 m and 0.11 m of arm, bent by 1 rad twice; the target is two slides that nothing moves.
        "Reacher": {
            "point": "fingertip",
            "target": "target",
            "goal_state": (1.0, 1.0, 0.1 * np.cos(1) + 0.11 * np.cos(2), 0.1 * np.sin(1) + 0.11 * np.sin(2)),
            "goal_radius": 0.02,
        },
        # The object on its goal, 5 cm above it; both are slides.
        "Pusher": {"point": "object", "target": "goal", "goal_state": (0.0,) * 11, "goal_radius": 0.07},
        "InvertedPendulum": {"point": ("pole", (0.0, 0.0, 0.6)), "goal_state": (0.0, 0.0), "goal_radius": 0.05},
        "InvertedDoublePendulum": {"point": "tip", "goal_state": (0.0, 0.0, 0.0), "goal_radius": 0.05},
    }
)


def task_from_gymnasium(env_id: str, **settings: Any) -> type[Task]:
    """A task class from a MuJoCo environment: its model and time step, a point and a goal state.

        Reach = task_from_gymnasium("Reacher-v5")
        Walk = task_from_gymnasium("Ant-v5", point="torso", goal_state=[...], goal_radius=0.2)

    The horizon is the environment's longest episode, actions are held for as many physics steps as it does so. It
    gives nothing but its model: not its reward, observation and starts, nor what its ``step`` does besides physics.

    Args:
        env_id: of an environment whose actions are the controls of its model.
        settings: those of :func:`rcg_jax.task_from_mujoco`; ``point`` and ``goal_state`` where :data:`DEFAULTS` does
            not have the environment.

    Raises:
        ConfigError: Gymnasium is not installed, there is no such environment, it is not MuJoCo's, its actions do
            something other than to set controls, or what has to come where is missing. One line, with what there is.
    """
    refuse = f"gymnasium:{env_id}"
    model, num_held, longest = _model(env_id, refuse)
    given = DEFAULTS.get(re.sub(r"-v\d+$", "", env_id), {}) | settings
    if "point" not in given or "goal_state" not in given:
        raise ConfigError(
            f"{refuse}: what has to come where for success is not known (it is for {', '.join(DEFAULTS)}): write a "
            f"file with Mine = rcg_jax.task_from_gymnasium({env_id!r}, point=..., goal_state=...) and "
            f"task=file.py:Mine; points are {points(model)}; goal_state is {model.nq} positions"
        )
    training = {"policy.action_repeat": num_held} | dict(given.pop("training", {}))
    return task_from_mujoco(model, **{"horizon": longest * num_held, "name": env_id, **given, "training": training})


def points(model: mujoco.MjModel) -> str:
    """The sites and bodies that move, in words."""
    sites, bodies = moving(model)
    return f"sites {listed(sites)}, bodies {listed(bodies)}"


def _model(env_id: str, refuse: str) -> tuple[mujoco.MjModel, int, int]:
    """An environment's model, the physics steps of one of its actions, and the actions of its longest episode."""
    if find_spec("gymnasium") is None:
        raise ConfigError(f"{refuse}: gymnasium is not installed: {ENVIRONMENTS['gymnasium'][1]}")
    import gymnasium

    there = find_spec("gymnasium_robotics") is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if env_id not in gymnasium.registry and ":" not in env_id and there:
            importlib.import_module("gymnasium_robotics")  # registers its own
        if env_id not in gymnasium.registry and ":" not in env_id:
            robotics = "" if there else ', or one of those of "pip install gymnasium-robotics", which is not here'
            hint = did_you_mean(env_id, gymnasium.registry)
            raise ConfigError(f"{refuse}: no such environment; {hint or 'none has a name like this'}{robotics}")
        try:
            env = gymnasium.make(env_id).unwrapped
        except Exception as error:
            raise ConfigError(f"{refuse}: gymnasium.make fails: {describe(error)}") from error
    model, spec = getattr(env, "model", None), gymnasium.spec(env_id)
    if not isinstance(model, mujoco.MjModel):
        raise ConfigError(f"{refuse}: has no MuJoCo model: must be a MuJoCo environment")
    if env.action_space.shape != (model.nu,):
        shape, mocap = env.action_space.shape, ", and a mocap body that they move" if model.nmocap else ""
        is_not = f"its actions, of shape {shape}, are not the controls of its model, which has {model.nu} actuators"
        raise ConfigError(f"{refuse}: {is_not}{mocap}: must be the controls")
    inner = [env, *(getattr(env, name, None) for name in ("point_env", "ant_env", "robot_env"))]
    held = [getattr(e, name, None) for e in inner for name in ("frame_skip", "n_substeps")]
    return model, next((int(n) for n in held if n), 1), int(spec.max_episode_steps or 500)
