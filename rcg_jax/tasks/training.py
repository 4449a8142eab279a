"""What a task trains with: what the user says, then the preset, then the task, then the defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from rcg_jax.config.compose import compose_config, given_names, show
from rcg_jax.config.names import did_you_mean
from rcg_jax.config.presets import TASK_SETTINGS
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.config.validate import requirement, validate
from rcg_jax.tasks import TASKS, make_task, task_class
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check import check_task
from rcg_jax.tasks.check_model import refuse

#: Groups of settings that are about learning; the others are about one run.
GROUPS = ("curriculum", "rollout", "trpo", "ppo", "policy", "baseline", "oracle", "self_play", "randomize")


def task_settings(task: str | type[Task]) -> dict[str, Any]:
    """What ``task=`` trains with instead of the defaults: settings by dotted name, of the types of :class:`Config`.

    They are those of :data:`rcg_jax.config.presets.TASK_SETTINGS`, or of a custom class's attribute ``training``; a
    subclass adds to, or replaces, those of the classes that it extends.

    Args:
        task: as of ``task=``, whose class is imported; or the class.

    Raises:
        ConfigError: no such task, the file of a custom class cannot be used, or ``training`` names what is no setting
            of :data:`GROUPS`, or gives it a value of another type. One line.
    """
    try:
        cls = task_class(task) if isinstance(task, str) else task
    except ValueError as error:
        raise ConfigError(str(error)) from error
    result: dict[str, Any] = {}
    for base in reversed(cls.__mro__):  # mixins that are no tasks count, too
        if base not in Task.__mro__:
            result |= _own_settings(base, cls)
    return result


def _own_settings(base: type, cls: type[Task]) -> dict[str, Any]:
    """What one of the classes that the task class ``cls`` extends asks for."""
    where = base if issubclass(base, Task) else cls
    name = getattr(base, "name", "")
    own = vars(base).get("training", TASK_SETTINGS.get(name, {}) if TASKS.get(name) is base else {})
    if not isinstance(own, Mapping):
        refuse(where, f"training is a {type(own).__name__}: must be a dict of settings of python -m rcg_jax.run")
    fields = {name: item for name, item, _ in flatten(Config()) if name.partition(".")[0] in GROUPS}
    result = {}
    for name, value in own.items():
        if name not in fields:
            refuse(
                where,
                f"training: {name} must be the dotted name of a setting, such as trpo.max_kl, of {', '.join(GROUPS)} "
                f"(--help lists them); {did_you_mean(str(name), fields)}".rstrip("; "),
            )
        try:
            result[name] = _typed(value, str(fields[name].type))
        except TypeError:
            refuse(where, f"training: {name}={value!r}: must be {requirement(fields[name])}")
    return result


def _typed(value: Any, kind: str) -> Any:
    """``value``, also of NumPy, as a setting of type ``kind`` has it; TypeError where it is of another type."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if kind == "list[int]" and isinstance(value, list | tuple):
        return [_typed(each, "int") for each in value]
    allowed = {"bool": bool, "str": str, "int": int, "float": int | float}.get(kind, ())
    if not isinstance(value, allowed) or (isinstance(value, bool) and kind != "bool"):
        raise TypeError
    return float(value) if kind == "float" else value


def resolve(
    config: Config, given: Collection[str], *, task: type[Task] | None = None, groups: Sequence[str] = GROUPS
) -> tuple[Config, list[str]]:
    """What a run trains with, given a composed configuration and the names of the settings that the user set.

    Args:
        config: composed: what the user says, then the preset, then the defaults.
        given: names of the settings that the user set.
        task: the task's class; by default that of ``config.task``.
        groups: the groups of settings in which the task has a say.

    Returns:
        The settings, and those of them, ``name=value``, that are as the task asks. ``rollout.num_envs`` and
        ``rollout.batch_size`` may still be left open: they depend on devices (:func:`rcg_jax.rl.sizes.with_sizes`).

    Raises:
        ConfigError: see :func:`task_settings`; or a value that is not allowed.
    """
    asked = {
        name: value
        for name, value in task_settings(task or config.task).items()
        if name not in given and name.partition(".")[0] in groups
    }
    if config.preset != "default":
        return config, []
    result = config
    for name, value in asked.items():
        group, _, last = name.partition(".")
        part = dataclasses.replace(getattr(result, group), **{last: value})
        result = dataclasses.replace(result, **{group: part})
    try:
        validate(result)
    except ConfigError as error:
        raise ConfigError(f"{error} (with training of task={task.spelled() if task else config.task})") from None
    return result, [f"{name}={show(value)}" for name, value in asked.items()]


def training_config(overrides: Sequence[str]) -> Config:
    """What ``python -m rcg_jax.run`` with these words trains with.

    Raises:
        ConfigError: as of :func:`rcg_jax.config.compose.compose_config` and :func:`resolve`.
    """
    return resolve(compose_config(overrides), given_names(overrides))[0]


def task_for_trainer(task: str | Task, engine: str, action_repeat: int | None) -> tuple[Task, int]:
    """A task for somebody else's trainer, and for how many physics steps its actions are held.

    Args:
        task: as of ``task=`` on the command line, or a task that is built.
        engine: physics, of a task given by name.
        action_repeat: physics steps per action; by default what the task trains with.

    Raises:
        ValueError: no such task or engine, or ``action_repeat`` is no integer >= 1.
    """
    settings = task_settings(type(task) if isinstance(task, Task) else task)
    default = settings.get("policy.action_repeat", Config().policy.action_repeat)
    repeat = default if action_repeat is None else action_repeat
    if not isinstance(repeat, int | np.integer) or repeat < 1:
        raise ValueError(f"action_repeat={repeat!r}: must be an integer >= 1")
    return checked_task(task, engine), int(repeat)


def checked_task(task: str | Task, engine: str) -> Task:
    """A task that is built, or the one called so, which is checked if it is a custom one.

    Raises:
        ValueError: no such task or engine, or (:class:`rcg_jax.tasks.check_model.ContractError`) a breach of the
            contract.
    """
    if isinstance(task, Task):
        return task
    built = make_task(task, engine)
    if task not in TASKS:
        check_task(built, starts=False)
    return built
