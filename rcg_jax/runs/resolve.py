"""The settings of a run, resolved: what the user says, then the preset, then the task, then the defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

from rcg_jax.config.compose import compose_config, given_names, show
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.config.validate import validate
from rcg_jax.tasks.training import task_settings


def resolve(config: Config, given: Collection[str]) -> tuple[Config, list[str]]:
    """What a run trains with, given a composed configuration and the names of the settings that the user set.

    Returns:
        The settings, and those of them, ``name=value``, that are as the task asks. ``rollout.num_envs`` and
        ``rollout.batch_size`` may still be left open: they depend on devices (:func:`rcg_jax.rl.sizes.with_sizes`).

    Raises:
        ConfigError: see :func:`task_settings`; or a value that is not allowed.
    """
    asked = {name: value for name, value in task_settings(config.task).items() if name not in given}
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
        raise ConfigError(f"{error} (with training of task={config.task})") from None
    return result, [f"{name}={show(value)}" for name, value in asked.items()]


def training_config(overrides: Sequence[str]) -> Config:
    """What ``python -m rcg_jax.run`` with these words trains with.

    Raises:
        ConfigError: as of :func:`rcg_jax.config.compose.compose_config` and :func:`resolve`.
    """
    return resolve(compose_config(overrides), given_names(overrides))[0]
