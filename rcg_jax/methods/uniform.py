"""The baseline: train on rho_0 itself, uniform over the feasible starts (section 5.1)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from rcg_jax.base import StartLabels, StartSet
from rcg_jax.config import CurriculumConfig
from rcg_jax.curriculum.select import difficulty
from rcg_jax.methods.method import MethodMetrics
from rcg_jax.tasks.task import Task


class Uniform:
    """rho_i = rho_0: fresh draws from S^0 in every iteration. Stateless."""

    def __init__(self, task: Task, config: CurriculumConfig) -> None:
        """Uniform starts on ``task``; as many per iteration as the curriculum methods use.

        Raises:
            FileNotFoundError: the task has no feasible set.
        """
        if not task.has_exact_sampler:
            task.feasible_starts()  # refuses now rather than while the train step is traced
        self._task = task
        self._config = config

    def init(self, key: Array) -> None:
        """Nothing to remember."""

    def propose(self, key: Array, state: None) -> StartSet:
        """N_new + N_old feasible starts."""
        return self._task.sample_feasible(key, self._config.num_new + self._config.num_old)

    def update(self, key: Array, state: None, starts: StartSet, labels: StartLabels) -> tuple[None, MethodMetrics]:
        """Only reports."""
        cfg = self._config
        kind = difficulty(starts, labels, r_min=cfg.r_min, r_max=cfg.r_max, min_episodes=cfg.min_episodes)
        low, good, high = (jnp.sum(mask) for mask in (kind.low, kind.good, kind.high))
        num = jnp.maximum(low + good + high, 1)
        zero = jnp.zeros(())
        return None, MethodMetrics(
            share_low=low / num,
            share_good=good / num,
            share_high=high / num,
            labelled=(low + good + high) / jnp.maximum(starts.count(), 1),
            brownian_horizon=zero,
            replay_size=jnp.zeros((), jnp.int32),
            walk_steps=zero,
        )
