"""Evaluation on rho_0: success over the task's fixed set of feasible starts (appendix A.2)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.rl.episodes import Episodes, run_episodes
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.tasks.base import Task
from rcg_jax.types import sample_rows


@struct.dataclass
class EvalResult:
    """Success on rho_0.

    Attributes:
        successes_stochastic: () int32, successful episodes of the stochastic policy; the paper's measure.
        successes_mean: () int32, of the policy's mean action.
        episodes: () int32, episodes of each.
        start: (E,) int32, which feasible starts were used.
        stochastic, mean: what happened in each episode.
    """

    successes_stochastic: Array
    successes_mean: Array
    episodes: Array
    start: Array
    stochastic: Episodes
    mean: Episodes


def make_evaluate(policy: GaussianPolicy, task: Task, episodes: int) -> Callable[[Actor, Array], EvalResult]:
    """Evaluation of what acts, with the stochastic policy and with its mean, from the same starts. Pure.

    Args:
        policy: pi.
        task: task and physics, not necessarily on the engine of the training.
        episodes: E episodes of each policy, from feasible starts drawn without replacement while there are enough.

    Raises:
        FileNotFoundError: the task has no feasible set.
    """
    feasible = task.feasible_starts()

    def evaluate(actor: Actor, key: Array) -> EvalResult:
        start_key, noise_key = jax.random.split(key)
        chosen = sample_rows(start_key, feasible, episodes)
        starts = feasible.take(jnp.concatenate([chosen, chosen]))
        mean_half = jnp.arange(2 * episodes) >= episodes
        result = run_episodes(task, policy, actor, noise_key, starts, deterministic=mean_half)
        stochastic = jax.tree.map(lambda x: x[:episodes], result)
        mean = jax.tree.map(lambda x: x[episodes:], result)
        return EvalResult(
            successes_stochastic=jnp.sum(stochastic.success),
            successes_mean=jnp.sum(mean.success),
            episodes=jnp.int32(episodes),
            start=chosen,
            stochastic=stochastic,
            mean=mean,
        )

    return evaluate
