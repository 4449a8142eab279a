"""What a task's class asks for of the settings of its training: between the defaults and what the user says."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from rcg_jax.config.compose import compose_config, given_names, requirement, show
from rcg_jax.config.names import ENGINES
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.config.validate import validate

#: Groups of settings that are about learning; the others are about one run.
GROUPS = ("curriculum", "rollout", "trpo", "policy", "baseline", "oracle", "self_play")


def _typed(value: Any, kind: str) -> Any:
    """``value`` as a setting of type ``kind`` has it; numbers and arrays of NumPy are numbers and lists.

    Raises:
        TypeError: it is of another type.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if kind == "list[int]" and isinstance(value, list | tuple):
        return [_typed(each, "int") for each in value]
    is_bool = isinstance(value, bool)
    if {"bool": is_bool, "str": isinstance(value, str)}.get(kind, False):
        return value
    if kind == "int" and isinstance(value, Integral) and not is_bool:
        return int(value)
    if kind == "float" and isinstance(value, Real) and not is_bool:
        return float(value)
    raise TypeError


def task_settings(task: str) -> dict[str, Any]:
    """``Task.training`` of a task's class, checked: settings by dotted name, of the types of :class:`Config`.

    Args:
        task: as of ``task=``; its class is imported.

    Raises:
        ConfigError: no such task, the file of an own class cannot be used, or ``training`` names what is no setting of
            :data:`GROUPS`, or gives it a value of another type. One line.
    """
    from rcg_jax.tasks import task_class  # imports JAX
    from rcg_jax.tasks.check_model import refuse

    try:
        cls = task_class(task)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    own = cls.training
    if not isinstance(own, Mapping):
        refuse(cls, f"training is a {type(own).__name__}: must be a dict of settings of python -m rcg_jax.run")
    fields = {name: item for name, item, _ in flatten(Config()) if name.partition(".")[0] in GROUPS}
    result = {}
    for name, value in own.items():
        if name not in fields:
            refuse(
                cls,
                f"training: {name} must be the dotted name of a setting, such as trpo.max_kl, of {', '.join(GROUPS)} "
                f"(--help lists them)",
            )
        try:
            result[name] = _typed(value, str(fields[name].type))
        except TypeError:
            refuse(cls, f"training: {name}={value!r}: must be {requirement(name)}")
    return result


def with_task_settings(config: Config, given: Collection[str]) -> Config:
    """``config`` with what its task's class asks for in ``Task.training``, except what was given.

    With ``preset=paper`` nothing changes: every task is trained as the paper trains it.

    Args:
        config: a composed configuration.
        given: names of the settings that the user set.

    Raises:
        ConfigError: see :func:`task_settings`; or a value that is not allowed.
    """
    if config.preset != "default":
        return config
    result = config
    for name, value in task_settings(config.task).items():
        if name not in given:
            group, _, last = name.partition(".")
            part = dataclasses.replace(getattr(result, group), **{last: value})
            result = dataclasses.replace(result, **{group: part})
    try:
        validate(result, engines=ENGINES)
    except ConfigError as error:
        raise ConfigError(f"{error} (with training of task={config.task})") from None
    return result


def kept(config: Config) -> list[str]:
    """What a configuration has as its task's class asks for it in ``Task.training``: ``name=value``.

    Raises:
        ConfigError: see :func:`task_settings`.
    """
    if config.preset != "default":
        return []
    values = {name: value for name, _, value in flatten(config)}
    return [f"{name}={show(value)}" for name, value in task_settings(config.task).items() if values[name] == value]


def training_config(overrides: Sequence[str]) -> Config:
    """What ``python -m rcg_jax.run`` with these words trains with: defaults, the task's own, preset, settings.

    Raises:
        ConfigError: as of :func:`rcg_jax.config.compose.compose_config` and :func:`with_task_settings`.
    """
    return with_task_settings(compose_config(overrides), given_names(overrides))
