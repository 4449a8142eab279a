"""Evaluation on rho_0: success over the task's fixed set of feasible starts (appendix A.2).

``python -m rcg_jax.evaluate run=DIR [engine=... episodes=... seed=... iteration=...]`` evaluates a finished or
running training run.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.base import PhysicsState, StartSet, sample_rows
from rcg_jax.config import Config
from rcg_jax.rl.policy import GaussianPolicy
from rcg_jax.tasks.task import Task
from rcg_jax.train import Agent, TrainState, make_policy


@struct.dataclass
class Episodes:
    """Outcome of one episode from each of B starts.

    Attributes:
        success: (B,) bool, the goal was reached within T steps.
        length: (B,) int32, steps until the goal, a failure, or the horizon.
        bad: (B,) bool, ended by non-finite physics.
    """

    success: Array
    length: Array
    bad: Array


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


def run_episodes(
    task: Task, policy: GaussianPolicy, agent: Agent, key: Array, starts: StartSet, deterministic: Array
) -> Episodes:
    """One episode from each start; stops early when all have ended.

    Args:
        task: task and physics.
        policy: pi.
        agent: its parameters and observation statistics.
        key: PRNG key of the action noise.
        starts: B starts, all valid.
        deterministic: (B,) bool, act by the policy's mean there.
    """
    Carry = tuple[Array, PhysicsState, Array, Array, Array, Array]
    noise_scale = jnp.where(deterministic, 0.0, 1.0)[:, None]

    def unfinished(carry: Carry) -> Array:
        t, _, _, _, alive, _ = carry
        return (t < task.horizon) & jnp.any(alive)

    def step(carry: Carry) -> Carry:
        t, physics, success, bad, alive, length = carry
        dist = policy(agent.policy, agent.norm(task.observe_batch(physics)))
        noise = jax.random.normal(jax.random.fold_in(key, t), dist.mean.shape)
        physics = task.step(physics, dist.sample(noise * noise_scale))
        s = task.snapshot(physics)
        success |= alive & jax.vmap(task.is_goal)(s) & ~physics.bad
        bad |= alive & physics.bad
        length = jnp.where(alive, t + 1, length)
        alive &= ~(success | bad | jax.vmap(task.is_failure)(s))
        return t + 1, physics, success, bad, alive, length

    none = jnp.zeros(starts.capacity, bool)
    carry = (jnp.int32(0), task.reset(starts), none, none, ~none, jnp.zeros(starts.capacity, jnp.int32))
    _, _, success, bad, _, length = jax.lax.while_loop(unfinished, step, carry)
    return Episodes(success=success, length=length, bad=bad)


def make_evaluate(config: Config, task: Task, episodes: int) -> Callable[[TrainState, Array], EvalResult]:
    """Evaluation of a train state with the stochastic and with the mean policy, from the same starts. Pure.

    Args:
        config: configuration of the run.
        task: task and physics, not necessarily on the engine of the training.
        episodes: E episodes of each policy, from feasible starts drawn without replacement while there are enough.

    Raises:
        FileNotFoundError: the task has no feasible set.
    """
    policy = make_policy(config, task)
    feasible = task.feasible_starts()

    def evaluate(state: TrainState, key: Array) -> EvalResult:
        start_key, noise_key = jax.random.split(key)
        chosen = sample_rows(start_key, feasible, episodes)
        starts = feasible.take(jnp.concatenate([chosen, chosen]))
        mean_half = jnp.arange(2 * episodes) >= episodes
        result = run_episodes(task, policy, state.agent, noise_key, starts, mean_half)
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
