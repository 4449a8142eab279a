"""What a task's class asks for of the settings of its training: between the defaults and what the user says."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcg_jax.cli import compose_config, given_names, requirement
from rcg_jax.config import Config, ConfigError, flatten
from rcg_jax.names import ENGINES
from rcg_jax.schema import make_schema
from rcg_jax.validate import validate

#: Groups of settings that are about learning; the others are about one run.
GROUPS = ("curriculum", "rollout", "trpo", "policy", "baseline", "oracle", "self_play")


def task_settings(task: str) -> dict[str, Any]:
    """``Task.training`` of a task's class, checked: settings by dotted name, of the types of :class:`Config`.

    Args:
        task: as of ``task=``; its class is imported.

    Raises:
        ConfigError: the file of an own class cannot be used, or ``training`` names what is no setting of
            :data:`GROUPS`, or gives it a value of another type. One line.
    """
    from rcg_jax.tasks import task_class  # imports JAX
    from rcg_jax.tasks.model_contract import refuse

    cls = task_class(task)
    own = cls.training
    if not isinstance(own, Mapping):
        refuse(cls, f"training is a {type(own).__name__}: must be a dict of settings of python -m rcg_jax.run")
    fields = {name: item for name, item, _ in flatten(Config()) if name.partition(".")[0] in GROUPS}
    schema = make_schema()
    for name, value in own.items():
        if name not in fields:
            refuse(cls, f"training: {name} is no setting of {', '.join(GROUPS)} (--help lists all)")
        try:
            OmegaConf.update(schema, name, value)
        except OmegaConfBaseException:
            refuse(cls, f"training: {name}={value!r}: must be {requirement(name)}")
    typed = {name: value for name, _, value in flatten(OmegaConf.to_object(schema))}
    return {name: typed[name] for name in own}


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
            result = dataclasses.replace(
                result, **{group: dataclasses.replace(getattr(result, group), **{last: value})}
            )
    try:
        validate(result, engines=ENGINES)
    except ConfigError as error:
        raise ConfigError(f"{error} (with training of task={config.task})") from None
    return result


def training_config(overrides: Sequence[str]) -> Config:
    """What ``python -m rcg_jax.run`` with these words trains with: defaults, the task's own, preset, settings.

    Raises:
        ConfigError: as of :func:`rcg_jax.cli.compose_config` and :func:`with_task_settings`.
    """
    return with_task_settings(compose_config(overrides), given_names(overrides))
