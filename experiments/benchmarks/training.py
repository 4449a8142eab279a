"""The compiled train step as the measuring scripts use it: sized, compiled, and run iteration by iteration."""

from __future__ import annotations

import dataclasses
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

import jax

from rcg_jax.config.settings import Config
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.program import load_program
from rcg_jax.runs.seeds import stack, strong
from rcg_jax.tasks import task_class

Result = TypeVar("Result")


def sized(config: Config, *, num_envs: int = 0, batch: int = 0) -> Config:
    """``config`` with that many environments and steps per TRPO iteration, 0 leaving both to the task.

    The baseline's minibatches grow with the batch, so that it takes as many Adam steps. Uses no device.

    Raises:
        ValueError: no such task.
    """
    task: Any = task_class(config.task)  # of which the horizon counts
    config = dataclasses.replace(
        config, rollout=dataclasses.replace(config.rollout, num_envs=num_envs, batch_size=batch)
    )
    config = with_sizes(config, task.horizon)
    usual = with_sizes(Config(), task.horizon).rollout.batch_size
    minibatch = max(1, round(config.baseline.minibatch_size * config.rollout.batch_size / usual))
    return dataclasses.replace(config, baseline=dataclasses.replace(config.baseline, minibatch_size=minibatch))


def measured(engine: str, measure: Callable[..., Result], *args: Any) -> Result:
    """``measure(*args)``; on ``engine=native`` in a process of its own, which a run with that engine has as well.

    It decides how many threads XLA has, before JAX starts (:func:`rcg_jax.sharding.devices.start_on_half_the_cores`).
    """
    if engine != "native":
        return measure(*args)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(measure, *args).result()


class Training:
    """The train step of one configuration, compiled ahead of its first call, as a run does.

    Attributes:
        state: the train state, with a leading axis of seeds if there are several.
        env_steps: configured steps of policy rollouts in one iteration, over all seeds; whole episodes take some more.
        compile_s: what tracing and compiling took [s].
        planned_gb: arguments, results and temporaries of one call by the compiler's own account [GiB]; 0 where the
            backend gives none.
    """

    def __init__(self, config: Config) -> None:
        """Compiles.

        Raises:
            ConfigError: the sizes do not fit each other or the task, or there are not so many devices.
        """
        program = load_program(config)
        first = range(config.seed, config.seed + config.num_seeds)
        init = jax.jit(program.init)
        self.state = program.devices.placed(strong(stack([init(seed) for seed in first])))
        begin = time.perf_counter()
        step = program.jit(
            program.devices.vmap(program.step) if config.num_seeds > 1 else program.step, donate_argnums=0
        )
        self._step = step.lower(self.state).compile()
        self.compile_s = time.perf_counter() - begin
        self.planned_gb = _planned_gb(self._step)
        config = program.config
        self.env_steps = config.rollout.batch_size * config.trpo.iterations * config.num_seeds

    def run(self) -> float:
        """One curriculum iteration; seconds."""
        begin = time.perf_counter()
        self.state, _ = jax.block_until_ready(self._step(self.state))
        return time.perf_counter() - begin


def _planned_gb(compiled: Any) -> float:
    try:
        plan = compiled.memory_analysis()
    except (NotImplementedError, jax.errors.JaxRuntimeError):
        plan = None
    if plan is None:
        return 0.0
    size = plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes - plan.alias_size_in_bytes
    return float(size) / 2**30
