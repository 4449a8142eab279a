"""One iteration of training in numbers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.rl.train_policy import TrpoIteration
from rcg_jax.tasks.base import Task


@struct.dataclass
class Metrics:
    """One iteration in numbers; all scalars.

    Attributes:
        iteration: curriculum iterations done, this one included.
        env_steps: physics steps of policy rollouts in this iteration, all that were simulated; logs hold their sum,
            which int32 could not.
        success: share of the counted episodes on rho_i that reached the goal.
        episodes: episodes counted.
        start_distance: mean distance of rho_i's starts to the goal [m].
        nonfinite: episodes ended by physics, an observation or a distance that turned non-finite.
        kl, surrogate_gain, line_search_attempts: means over the TRPO iterations. accepted: share of accepted steps.
        policy_std: mean standard deviation of the policy.
        value_error: root mean squared error of V before it was fitted, mean over the TRPO iterations.
        starts: what the start-state method reports.
    """

    iteration: Array
    env_steps: Array
    success: Array
    episodes: Array
    start_distance: Array
    nonfinite: Array
    kl: Array
    surrogate_gain: Array
    line_search_attempts: Array
    accepted: Array
    policy_std: Array
    value_error: Array
    starts: Any


def make_metrics(task: Task, state: Any, shown: TrpoIteration, of_method: Any) -> Metrics:
    """The metrics of an iteration.

    Args:
        task: task and physics.
        state: the train state after it (:class:`rcg_jax.train_step.TrainState`).
        shown: what its TRPO iterations showed.
        of_method: what the start-state method reports (:class:`rcg_jax.methods.base.MethodMetrics`).
    """
    distance = jax.vmap(task.distance)(task.snapshot(task.reset(state.starts)))
    known = state.starts.valid & jnp.isfinite(distance)
    episodes = jnp.sum(shown.labels.episodes)
    return Metrics(
        iteration=state.iteration,
        env_steps=jnp.sum(shown.env_steps),
        success=jnp.sum(shown.labels.successes) / jnp.maximum(episodes, 1),
        episodes=episodes,
        start_distance=jnp.sum(jnp.where(known, distance, 0.0)) / jnp.maximum(jnp.sum(known), 1),
        nonfinite=jnp.sum(shown.nonfinite),
        kl=jnp.mean(shown.trpo.kl),
        surrogate_gain=jnp.mean(shown.trpo.gain),
        line_search_attempts=jnp.mean(shown.trpo.attempts),
        accepted=jnp.mean(shown.trpo.accepted),
        policy_std=jnp.mean(jnp.exp(state.agent.policy.log_std)),
        value_error=jnp.mean(shown.value_error),
        starts=of_method,
    )
