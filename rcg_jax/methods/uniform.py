"""The baseline: train on rho_0 itself, uniform over the feasible starts (section 5.1)."""

from __future__ import annotations

from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.methods.base import MethodMetrics, classify_starts
from rcg_jax.rl.agent import Agent
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet


class Uniform:
    """rho_i = rho_0: fresh draws from S^0 in every iteration. Stateless."""

    def __init__(self, task: Task, config: Config) -> None:
        """Uniform starts on ``task``; as many per iteration as the curriculum methods use.

        Raises:
            FileNotFoundError: the task has no feasible set.
        """
        if not task.has_exact_sampler():
            task.feasible_starts()  # refuses now rather than while the train step is traced
        self._task = task
        self._config = config.curriculum

    def init(self, key: Array) -> None:
        """Nothing to remember."""

    def propose(self, key: Array, state: None, agent: Agent) -> tuple[None, StartSet]:
        """N_new + N_old feasible starts."""
        return None, self._task.sample_feasible(key, self._config.num_new + self._config.num_old)

    def update(self, key: Array, state: None, starts: StartSet, labels: StartLabels) -> tuple[None, MethodMetrics]:
        """Only reports."""
        return None, classify_starts(self._config, starts, labels)[1]
