"""Rollouts of the policy from starts of rho_i, and what they say about each start."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.rl.hold import active_mask, decisions, hold
from rcg_jax.sharding.devices import any_of_all_seeds, over_devices
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, Snapshot, StartLabels, StartSet, finite, where_rows


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
        terminal: goal, failure or non-finite numbers: nothing follows.
        done: terminal, or the horizon T was reached.
        age: physics steps of this episode so far, these included.
        start: row of rho_i of this episode.
        counted: this episode labels its start; of whole episodes: it is part of the batch.
        bad: physics, the observation, or the distance turned non-finite; the episode ends as a failure.
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
    return draw_from(key, valid_first(starts), starts.count(), shape)


def valid_first(starts: StartSet) -> Array:
    """(C,) row numbers, those of valid starts first."""
    return jnp.argsort(~starts.valid, stable=True)


def draw_from(key: Array, rows: Array, count: Array, shape: tuple[int, ...]) -> Array:
    """Independent uniform draws from the first ``count`` of ``rows``."""
    return rows[jax.random.randint(key, shape, 0, jnp.maximum(count, 1))]


def observed(task: Task, starts: StartSet) -> tuple[PhysicsState, Array]:
    """Simulations in the given starts, ``bad`` where observation or distance are not finite, and observations."""
    physics = task.reset(starts)
    s = task.snapshot(physics)
    obs, seen = finite(jax.vmap(task.observe)(s))
    return dataclasses.replace(physics, bad=~(seen & finite(jax.vmap(task.distance)(s)[:, None])[1])), obs


def begin(task: Task, key: Array, starts: StartSet, num_envs: int) -> EnvState:
    """N environments at fresh starts."""
    index = draw(key, starts, (num_envs,))
    physics, obs = observed(task, starts.take(index))
    return EnvState(
        physics=physics,
        obs=obs,
        start=index.astype(jnp.int32),
        age=jnp.zeros(num_envs, jnp.int32),
        counted=jnp.ones(num_envs, bool),
    )


@dataclass(frozen=True)
class Sampler:
    """How one action is taken in N environments and what follows an episode; shared by both kinds of batch.

    Attributes:
        task: task and physics.
        act: (raw observations (N, obs_dim), standard normal noise (N, nu)) -> actions (N, nu).
        repeat: k, physics steps of an action. Where an episode ends between two actions, what is left of the k
            steps counts for nothing.
        gamma: discount per physics step, within the k steps.
        distance_weight: penalty per metre and step; 0: the paper's sparse reward.
    """

    task: Task
    act: Callable[[Array, Array], Array]
    repeat: int = 1
    gamma: float = 1.0
    distance_weight: float = 0.0

    @property
    def longest(self) -> int:
        """Actions of an episode that nothing ends before T."""
        return decisions(self.task.horizon, self.repeat)

    def outcome(self, s: Snapshot) -> tuple[Array, Array, Array, Array]:
        """Goal, failure and penalty of one state, and whether its distance to the goal is finite."""
        distance, seen = finite(self.task.distance(s)[None])
        return self.task.is_goal(s), self.task.is_failure(s), self.distance_weight * distance[0], seen

    def step(
        self, env: EnvState, noise: Array, fresh: tuple[PhysicsState, Array, Array], counts: Array
    ) -> tuple[EnvState, Transition]:
        """One action in each environment; a finished episode is followed by the next.

        Args:
            env: N environments.
            noise: (N, nu) of the actions.
            fresh: physics, observations and rows of rho_i that the next episodes begin in.
            counts: () bool, whether an episode that begins after this action labels its start.
        """
        task = self.task
        action = self.act(env.obs, noise)
        physics, s, ((goal, failure, penalty, known), bad) = hold(task, env.physics, action, self.repeat, self.outcome)
        obs, seen = finite(jax.vmap(task.observe)(s))
        # What a policy cannot see ends the episode with the last of the k steps; nothing of it is learned from.
        bad = bad | ~known
        bad = bad.at[0].set(bad[0] | env.physics.bad)
        bad = bad.at[-1].set(bad[-1] | ~seen)
        goal &= ~bad
        ended = goal | failure | bad
        live = active_mask(ended, task.horizon - env.age)
        terminal = jnp.any(live & ended, axis=0)
        age = env.age + jnp.sum(live, axis=0, dtype=jnp.int32)
        done = terminal | (age >= task.horizon)
        discount = self.gamma ** jnp.arange(self.repeat)[:, None]
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

        fresh_physics, fresh_obs, fresh_rows = fresh
        after = EnvState(
            physics=where_rows(done, fresh_physics, physics),
            obs=where_rows(done, fresh_obs, obs),
            start=jnp.where(done, fresh_rows, env.start),
            age=jnp.where(done, 0, age),
            counted=jnp.where(done, counts, env.counted),
        )
        return after, transition


def _random(sampler: Sampler, key: Array, starts: StartSet, length: int, num_envs: int) -> tuple[Array, Array]:
    """Noise (length, N, nu) of all actions and the rows (length, N) of rho_i that follow them."""
    noise_key, start_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (length, num_envs, sampler.task.action_dim))
    fresh = draw(start_key, starts, (length, num_envs)).astype(jnp.int32)
    return over_devices(noise, axis=1), over_devices(fresh, axis=1)


def rollout(
    sampler: Sampler, key: Array, env: EnvState, starts: StartSet, *, length: int, remaining: Array
) -> tuple[EnvState, Transition]:
    """A segment: L actions in each environment; after a finished episode the next begins in a freshly drawn start.

    Args:
        sampler: task, policy, and how they meet.
        key: PRNG key.
        env: environments to continue.
        starts: rho_i.
        length: L.
        remaining: () int32, physics steps left, this segment included, before the episodes under way are abandoned.
            An episode labels its start only if it begins T or more steps before that, so that it ends for
            certain, however it goes: otherwise quick successes would be counted more often than slow failures.

    Returns:
        Environments after the last step, and the transitions.
    """
    task, repeat = sampler.task, sampler.repeat
    env = jax.tree.map(over_devices, env)
    noise, fresh = _random(sampler, key, starts, length, env.age.shape[0])
    fresh_states, start_obs = observed(task, starts)

    def step(env: EnvState, x: tuple[Array, Array, Array]) -> tuple[EnvState, Transition]:
        t, noise, rows = x
        counts = remaining - (t + 1) * repeat >= sampler.longest * repeat
        return sampler.step(env, noise, (jax.tree.map(lambda x: x[rows], fresh_states), start_obs[rows], rows), counts)

    return jax.lax.scan(step, env, (jnp.arange(length), noise, fresh))


def whole_episodes(sampler: Sampler, key: Array, starts: StartSet, *, num_envs: int, length: int) -> Transition:
    """Whole episodes from fresh starts of rho_i, as the paper's software collects them for each TRPO iteration.

    Every environment begins episodes, one after the other, during its first L actions, and finishes the last of them.
    Which episodes begin depends on earlier ones only, never on how they are going to end, so that short ones have no
    advantage, and at least L * N actions belong to them. Actions that an environment takes after its last episode,
    while it waits for the others, are not ``counted``.

    Args:
        sampler: task, policy, and how they meet.
        key: PRNG key.
        starts: rho_i.
        num_envs: N.
        length: L.

    Returns:
        Transitions of L - 1 + ceil(T / k) rows. Those that are ``counted`` are the batch; what the others hold means
        nothing, and rows after the last finished episode were never simulated.
    """
    task, rows = sampler.task, length - 1 + sampler.longest
    begin_key, key = jax.random.split(key)
    env = jax.tree.map(over_devices, begin(task, begin_key, starts, num_envs))
    noise, fresh = _random(sampler, key, starts, rows, num_envs)
    fresh_states, start_obs = observed(task, starts)

    def step(t: Array, env: EnvState) -> tuple[EnvState, Transition]:
        row = fresh[t]
        return sampler.step(
            env, noise[t], (jax.tree.map(lambda x: x[row], fresh_states), start_obs[row], row), t + 1 < length
        )

    like = jax.eval_shape(lambda: step(jnp.int32(0), env)[1])
    empty = jax.tree.map(lambda x: over_devices(jnp.zeros((rows, *x.shape), x.dtype), axis=1), like)
    Carry = tuple[Array, EnvState, Transition]

    def unfinished(carry: Carry) -> Array:
        return any_of_all_seeds(carry[1].counted)

    def advance(carry: Carry) -> Carry:
        t, env, batch = carry
        env, transition = step(t, env)
        return t + 1, env, jax.tree.map(lambda all, one: all.at[t].set(one), batch, transition)

    return jax.lax.while_loop(unfinished, advance, (jnp.int32(0), env, empty))[2]


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
