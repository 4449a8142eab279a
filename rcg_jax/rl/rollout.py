"""Rollouts of the policy from starts of rho_i, and what they say about each start."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.base import PhysicsState, Snapshot, StartLabels, StartSet
from rcg_jax.devices import over_devices
from rcg_jax.rl.hold import before_end, decisions, hold
from rcg_jax.tasks.task import Task


@struct.dataclass
class EnvState:
    """N environments between two actions.

    Attributes:
        physics: N simulations.
        obs: (N, obs_dim) raw observations of them.
        start: (N,) int32, the row of rho_i that the running episode began in.
        age: (N,) int32, physics steps since then.
        counted: (N,) bool, whether the running episode will label its start.
    """

    physics: PhysicsState
    obs: Array
    start: Array
    age: Array
    counted: Array


@struct.dataclass
class Transition:
    """L actions of N environments, each held for k steps of physics; every leaf (L, N, ...).

    Attributes:
        obs: raw observation of s_t.
        action: as sampled, before clipping.
        success: one of the k states that it led through is in S^g.
        reward: 1 there (section 3.2), less ``distance_weight`` times the distance to the goal (appendix B.1), summed
            over the steps and discounted to the first of them.
        next_obs: raw observation after the last of the k steps, before any reset; where T is no multiple of k, V at the
            horizon is that of a state up to k - 1 steps later.
        terminal: goal, failure or non-finite physics: nothing follows.
        done: terminal, or the horizon T was reached.
        age: physics steps of this episode so far, these included.
        start: row of rho_i of this episode.
        counted: this episode labels its start.
        bad: physics turned non-finite.
    """

    obs: Array
    action: Array
    success: Array
    reward: Array
    next_obs: Array
    terminal: Array
    done: Array
    age: Array
    start: Array
    counted: Array
    bad: Array


def draw(key: Array, starts: StartSet, shape: tuple[int, ...]) -> Array:
    """Indices of valid starts, independent and uniform: rho_i = Unif(starts). At least one must be valid."""
    order = jnp.argsort(~starts.valid, stable=True)
    return order[jax.random.randint(key, shape, 0, jnp.maximum(starts.count(), 1))]


def begin(task: Task, key: Array, starts: StartSet, num_envs: int) -> EnvState:
    """N environments at fresh starts."""
    index = draw(key, starts, (num_envs,))
    physics = task.reset(starts.take(index))
    return EnvState(
        physics=physics,
        obs=task.observe_batch(physics),
        start=index.astype(jnp.int32),
        age=jnp.zeros(num_envs, jnp.int32),
        counted=jnp.ones(num_envs, bool),
    )


def rollout(
    task: Task,
    act: Callable[[Array, Array], Array],
    key: Array,
    env: EnvState,
    starts: StartSet,
    *,
    length: int,
    remaining: Array,
    repeat: int = 1,
    gamma: float = 1.0,
    distance_weight: float = 0.0,
) -> tuple[EnvState, Transition]:
    """L actions in each environment; after a finished episode the next begins in a freshly drawn start.

    Args:
        task: task and physics.
        act: (raw observations (N, obs_dim), standard normal noise (N, nu)) -> actions (N, nu).
        key: PRNG key.
        env: environments to continue.
        starts: rho_i.
        length: L.
        remaining: () int32, physics steps left, this segment included, before the episodes under way are abandoned.
            An episode labels its start only if it begins T or more steps before that, so that it ends for
            certain, however it goes: otherwise quick successes would be counted more often than slow failures.
        repeat: k, physics steps of an action. Where an episode ends between two actions, what is left of the k
            steps counts for nothing.
        gamma: discount per physics step, within the k steps.
        distance_weight: penalty per metre and step; 0: the paper's sparse reward.

    Returns:
        Environments after the last step, and the transitions.
    """
    noise_key, start_key = jax.random.split(key)
    num_envs = env.age.shape[0]
    env = jax.tree.map(over_devices, env)
    noise = over_devices(jax.random.normal(noise_key, (length, num_envs, task.action_dim)), axis=1)
    fresh = over_devices(draw(start_key, starts, (length, num_envs)).astype(jnp.int32), axis=1)
    start_obs = task.observe_batch(task.reset(starts))
    longest = decisions(task.horizon, repeat) * repeat
    discount = gamma ** jnp.arange(repeat)[:, None]

    def outcome(s: Snapshot) -> tuple[Array, Array, Array]:
        penalty = distance_weight * task.distance(s) if distance_weight else jnp.zeros(())
        return task.is_goal(s), task.is_failure(s), penalty

    def step(env: EnvState, x: tuple[Array, Array, Array]) -> tuple[EnvState, Transition]:
        t, noise, fresh = x
        action = act(env.obs, noise)
        physics, s, ((goal, failure, penalty), bad) = hold(task, env.physics, action, repeat, outcome)
        obs = jax.vmap(task.observe)(s)
        goal &= ~bad
        ended = goal | failure | bad
        live = before_end(ended, task.horizon - env.age)
        terminal = jnp.any(live & ended, axis=0)
        age = env.age + jnp.sum(live, axis=0, dtype=jnp.int32)
        done = terminal | (age >= task.horizon)
        transition = Transition(
            obs=env.obs,
            action=action,
            success=jnp.any(live & goal, axis=0),
            reward=jnp.sum(discount * jnp.where(live, goal - jnp.where(bad, 0.0, penalty), 0.0), axis=0),
            next_obs=obs,
            terminal=terminal,
            done=done,
            age=age,
            start=env.start,
            counted=env.counted,
            bad=jnp.any(live & bad, axis=0),
        )

        def pick(new: Array, old: Array) -> Array:
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

        after = EnvState(
            physics=jax.tree.map(pick, task.reset(starts.take(fresh)), physics),
            obs=pick(start_obs[fresh], obs),
            start=pick(fresh, env.start),
            age=jnp.where(done, 0, age),
            counted=jnp.where(done, remaining - (t + 1) * repeat >= longest, env.counted),
        )
        return after, transition

    return jax.lax.scan(step, env, (jnp.arange(length), noise, fresh))


def label_starts(batch: Transition, capacity: int) -> StartLabels:
    """R(pi, s_0) of every start by the counted episodes that ended in ``batch`` (section 4.3).

    Args:
        batch: transitions; any number of leading axes.
        capacity: C of rho_i.
    """
    ended = batch.done & batch.counted
    solved = ended & batch.success
    zero = jnp.zeros(capacity, jnp.int32)
    return StartLabels(
        successes=zero.at[batch.start].add(solved),
        episodes=zero.at[batch.start].add(ended),
        steps=zero.at[batch.start].add(jnp.where(solved, batch.age, 0)),
    )
