"""Domain randomisation: a task whose simulations differ in their physics."""

from __future__ import annotations

import copy
import dataclasses

from rcg_jax.config.settings import ConfigError, RandomizeConfig
from rcg_jax.physics.engine import UnsupportedModelError
from rcg_jax.physics.native import NativeEngine
from rcg_jax.physics.variants import SCALES, random_variants
from rcg_jax.tasks.base import Task


def randomized(task: Task, config: RandomizeConfig | None = None, **spread: float) -> Task:
    """``task`` with physics that differ from simulation to simulation, for training: policies that stand more.

    The models are drawn once, the same for all seeds; simulation i of a batch has that of variant i modulo
    ``config.variants``. Everything else, ``task.model`` included, stays as it is.

    Args:
        task: task on ``engine=native``.
        config: which of its quantities vary, and how much.
        **spread: the same, by name: ``mass=0.3``.

    Returns:
        A copy; ``task`` itself where nothing varies.

    Raises:
        ConfigError: another engine, a name that is not known, or motors are to vary and the model has muscles.
    """
    try:
        config = dataclasses.replace(config or RandomizeConfig(), **spread)  # type: ignore[arg-type]
    except TypeError:
        raise ConfigError(f"randomize: {', '.join(spread)}: must be of {', '.join(SCALES)}") from None
    wanted = {name: getattr(config, name) for name in SCALES}
    if not any(wanted.values()):
        return task
    if task.engine.name != NativeEngine.name:
        raise ConfigError(f"randomize: needs engine=native, not {task.engine.name}")
    varied = copy.copy(task)
    try:
        varied.engine = NativeEngine(task.model, random_variants(task.model, wanted, config.variants, seed=0))
    except UnsupportedModelError as error:
        raise ConfigError(f"randomize.{error}") from None
    return varied
