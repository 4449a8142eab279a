"""Evaluation on rho_0: success over the task's fixed set of feasible starts (appendix A.2).

``python -m rcg_jax.evaluate run=DIR [engine=... episodes=... seed=... iteration=...]`` evaluates a finished or
running training run, ``policy=NAME`` a shipped policy or a policy's file.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.base import sample_rows
from rcg_jax.config import Config
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.episodes import Episodes, run_episodes
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.rl.sizes import action_repeat
from rcg_jax.tasks.task import Task
from rcg_jax.train import TrainState


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


def make_evaluate(config: Config, task: Task, episodes: int) -> Callable[[TrainState, Array], EvalResult]:
    """Evaluation of a train state with the stochastic and with the mean policy, from the same starts. Pure.

    Args:
        config: configuration of the run.
        task: task and physics, not necessarily on the engine of the training.
        episodes: E episodes of each policy, from feasible starts drawn without replacement while there are enough.

    Raises:
        FileNotFoundError: the task has no feasible set.
    """
    policy = make_policy(config, task.action_dim, action_repeat(config, task))
    evaluate = make_actor_evaluate(policy, task, episodes)
    return lambda state, key: evaluate(state.agent.actor, key)


def make_actor_evaluate(
    policy: GaussianPolicy, task: Task, episodes: int, horizon: int | None = None
) -> Callable[[Actor, Array], EvalResult]:
    """As :func:`make_evaluate`, of what acts alone.

    Args:
        policy: pi.
        task: task and physics.
        episodes: E.
        horizon: steps that an episode may take; the task's T by default.

    Raises:
        FileNotFoundError: the task has no feasible set.
    """
    feasible = task.feasible_starts()

    def evaluate(actor: Actor, key: Array) -> EvalResult:
        start_key, noise_key = jax.random.split(key)
        chosen = sample_rows(start_key, feasible, episodes)
        starts = feasible.take(jnp.concatenate([chosen, chosen]))
        mean_half = jnp.arange(2 * episodes) >= episodes
        result = run_episodes(task, policy, actor, noise_key, starts, mean_half, horizon)
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


def wilson_interval(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success probability, 95 % by default.

    Args:
        successes: number of successes.
        episodes: number of trials, >= 1.
        z: normal quantile.
    """
    rate = successes / episodes
    spread = 1 + z * z / episodes
    centre = (rate + z * z / (2 * episodes)) / spread
    half = z * ((rate * (1 - rate) + z * z / (4 * episodes)) / episodes) ** 0.5 / spread
    return max(0.0, centre - half), min(1.0, centre + half)


if __name__ == "__main__":
    import sys

    from rcg_jax.evaluate_run import main

    sys.exit(main())
