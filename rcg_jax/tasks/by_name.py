"""Tasks that ``task=`` names without a class: a model's file, or an environment of Gymnasium or MuJoCo Playground."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco

from rcg_jax.config.class_path import class_name, split_environment, split_model
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.console import one_line
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.from_gymnasium import task_from_gymnasium
from rcg_jax.tasks.from_mujoco import listed, moving, task_from_mujoco
from rcg_jax.tasks.from_playground import task_from_playground


@functools.cache
def made_task(name: str) -> type[Task]:
    """The class of ``path/to/model.xml:POINT@KEYFRAME``, ``gymnasium:ENV_ID`` or ``playground:ENV``, made once.

    Its feasible starts lie beside the model; those of an environment in the current folder.

    Raises:
        ConfigError: what the name says is not there, or does not say what has to come where. One line.
    """
    label = class_name(name)
    if model := split_model(name):
        cls, folder = _of_model(name, label, *model), Path(model[0]).parent
    else:
        whose, environment = split_environment(name) or ("", "")
        make: Callable[..., type[Task]] = task_from_gymnasium if whose == "gymnasium" else task_from_playground
        cls, folder = make(environment, name=label), Path.cwd()
        label = f"{whose}.{label}"
    cls.spelling = name  # type: ignore[attr-defined]
    cls.feasible_file = folder / f"{label}.npz"
    return cls


def _of_model(name: str, label: str, file: str, point: str, keyframe: str) -> type[Task]:
    try:
        model = mujoco.MjSpec.from_file(file).compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"task={name}: {one_line(error)}") from None
    sites, bodies = moving(model)
    keys = [model.key(i).name for i in range(model.nkey)]
    if not point and len(sites) != 1:
        which = f"its sites that move are {listed(sites)}, its bodies {listed(bodies)}"
        raise ConfigError(f"task={name}: which point has to come to the goal? Write {Path(file).name}:POINT; {which}")
    if (keyframe or "goal") not in keys:
        raise ConfigError(f"task={name}: {_no_goal(Path(file).name, point, keyframe, keys)}")
    try:
        return task_from_mujoco(file, point=point or sites[0], goal_state=keyframe or "goal", name=label)
    except ConfigError as error:
        raise ConfigError(f"task={name}: {error}") from None


def _no_goal(file: str, point: str, keyframe: str, keys: Sequence[str]) -> str:
    missing = f"it has no keyframe {keyframe or 'goal'}, the state in which the task is done; it has {listed(keys)}"
    ways = f"write {file}:{point or 'POINT'}@KEYFRAME, or give goal_state to task_from_mujoco (docs/custom_tasks.md)"
    return f"{missing}; {ways}"
