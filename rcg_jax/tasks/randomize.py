"""Domain randomisation: a task whose simulations differ in their physics."""

from __future__ import annotations

import dataclasses

from rcg_jax.config.settings import ConfigError, RandomizeConfig
from rcg_jax.config.validate import check_value
from rcg_jax.physics.engine import UnsupportedModelError
from rcg_jax.physics.native import NativeEngine
from rcg_jax.physics.variants import SCALES, random_variants
from rcg_jax.tasks.base import Task


def randomized(task: Task, config: RandomizeConfig | None = None, **spread: float) -> Task:
    """``task`` with physics that differ from simulation to simulation, for training: policies that withstand more.

    The models are drawn once, the same for all seeds; simulation i of a batch has that of variant i modulo
    ``config.variants``. Everything else, ``task.model`` included, stays as it is.

    Args:
        task: task on ``engine=native``.
        config: which of its quantities vary, and how much.
        **spread: the same, by name: ``mass=0.3``.

    Returns:
        A copy; ``task`` itself where nothing varies.

    Raises:
        ConfigError: another engine, a task that varies already, a name or a value that is not allowed, or the model has
            nothing of that kind.
    """
    fields = {item.name: item for item in dataclasses.fields(RandomizeConfig)}
    if unknown := [name for name in spread if name not in fields]:
        raise ConfigError(f"randomize: {', '.join(unknown)}: must be of {', '.join(fields)}")
    config = dataclasses.replace(config or RandomizeConfig(), **spread)  # type: ignore[arg-type]
    for name, item in fields.items():
        check_value(f"randomize.{name}", item, getattr(config, name))
    wanted = {name: getattr(config, name) for name in SCALES}
    if not any(wanted.values()):
        return task
    if not isinstance(task.engine, NativeEngine):
        raise ConfigError(f"randomize: needs engine=native, not {task.engine.name}")
    if task.engine.variants:
        raise ConfigError("randomize: the task varies already; give all that varies at once")
    try:
        variants = random_variants(task.model, wanted, config.variants, seed=0)
    except UnsupportedModelError as error:
        raise ConfigError(f"randomize.{error}") from None
    return task.with_engine(NativeEngine(task.model, variants))
