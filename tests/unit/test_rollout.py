"""Rollouts and the labels they give, on coin tosses with known probabilities."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy import stats

from rcg_jax.rl.rollout import EnvState, Sampler, Transition, begin, label_starts, rollout
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartSet
from tests.analytic import Coin, make_starts


def toss(obs: Array, noise: Array) -> Array:
    """A standard normal policy."""
    return noise


@partial(jax.jit, static_argnames=("task", "num_envs", "length", "segments", "act"))
def run(
    task: Task,
    key: Array,
    starts: StartSet,
    *,
    num_envs: int,
    length: int,
    segments: int = 1,
    act: Callable[[Array, Array], Array] = toss,
) -> tuple[EnvState, Transition]:
    """One curriculum iteration's rollouts; the steps (segments * length, N) of all of them."""
    begin_key, key = jax.random.split(key)

    def segment(env: EnvState, x: tuple[Array, Array]) -> tuple[EnvState, Transition]:
        i, key = x
        remaining = (segments - i) * length
        return rollout(Sampler(task, act), key, env, starts, length=length, remaining=remaining)

    xs = jnp.arange(segments), jax.random.split(key, segments)
    env, batch = jax.lax.scan(segment, begin(task, begin_key, starts, num_envs), xs)
    return env, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)


def to_numpy(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)


# ------------------------------------------------------------------------------------------------------- labels


def test_labels_are_unbiased_where_counting_all_finished_episodes_is_not() -> None:
    """Quick successes against failures that take the whole horizon, over two horizons in four segments.

    Of the episodes that begin in the second half only successes can end in time. Whoever counts them finds every
    start easier than it is.
    """
    task = Coin([0.01, 0.02, 0.05, 0.1], horizon=40)
    starts = task.starts()
    _, batch = run(task, jax.random.key(0), starts, num_envs=3_000, length=20, segments=4)
    labels = to_numpy(label_starts(batch, starts.capacity))
    done, start = np.asarray(batch.done), np.asarray(batch.start)
    for i, p in enumerate(task.success_probability):
        n, k = labels.episodes[i], labels.successes[i]
        assert n > 400
        assert abs(k / n - p) < 4 * np.sqrt(p * (1 - p) / n)
        finished = done & (start == i)
        naive_k, naive_n = np.sum(finished & (np.asarray(batch.reward) > 0)), np.sum(finished)
        if p < 0.95:
            assert (naive_k / naive_n - p) / np.sqrt(p * (1 - p) / naive_n) > 5
    np.testing.assert_allclose(labels.success_rate, labels.successes / labels.episodes, rtol=1e-6)
    done, start, solved = (np.asarray(x) for x in (batch.done, batch.start, batch.reward > 0))
    age = np.zeros(done.shape[1], int)  # an independent clock of each episode
    total = np.zeros(starts.capacity, int)
    for t in range(len(done)):
        age += 1
        counted = done[t] & solved[t] & np.asarray(batch.counted)[t]
        np.add.at(total, start[t][counted], age[counted])
        age[done[t]] = 0
    np.testing.assert_array_equal(labels.steps, total)
    np.testing.assert_allclose(labels.time_to_goal, total / labels.successes, rtol=1e-6)
    assert labels.episodes.sum() > 1.5 * 3_000  # more than the first episode of each environment


@pytest.fixture(scope="module")
def recorded() -> tuple[EnvState, Transition]:
    """Ten segments with every kind of end; episodes span up to four of them. The last start is invalid."""
    env, batch = run(TASK, jax.random.key(2), STARTS, num_envs=150, length=LENGTH, segments=SEGMENTS)
    return to_numpy(env), to_numpy(batch)


TASK = Coin([0.01, 0.05, 0.2, 0.5], failure=0.03, nonfinite=0.02, horizon=15)
STARTS = TASK.starts(valid=[True, True, True, False])
LENGTH, SEGMENTS = 6, 10


def test_exactly_the_episodes_that_must_end_in_time_are_counted(recorded: tuple[EnvState, Transition]) -> None:
    """Counted: begun a whole horizon or more before the end of the last segment. All of those are finished there."""
    env, batch = recorded
    total, num_envs = batch.done.shape
    episodes, successes, late = np.zeros(4, int), np.zeros(4, int), 0
    for n in range(num_envs):
        begun = 0
        for t in range(total):
            in_time = total - begun >= TASK.horizon
            assert batch.counted[t, n] == in_time
            if batch.done[t, n]:
                episodes[batch.start[t, n]] += in_time
                successes[batch.start[t, n]] += in_time and batch.reward[t, n] > 0
                late += not in_time
                begun = t + 1
        assert env.counted[n] == (total - begun >= TASK.horizon)
    assert late > 0
    assert not env.counted.any()
    labels = to_numpy(label_starts(batch, 4))
    np.testing.assert_array_equal(labels.episodes, episodes)
    np.testing.assert_array_equal(labels.successes, successes)
    # A start that was never tried has no success rate to speak of, and no NaN either.
    assert labels.episodes[3] == 0
    assert labels.success_rate[3] == 0


def test_labels_of_segments_add_up(recorded: tuple[EnvState, Transition]) -> None:
    batch = recorded[1]
    parts = [label_starts(jax.tree.map(lambda x, s=s: x[s], batch), 4) for s in (slice(0, 10), slice(10, None))]
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(jnp.add, *parts), label_starts(batch, 4))


# -------------------------------------------------------------------------------------------------- bookkeeping


def test_every_step_knows_its_episode(recorded: tuple[EnvState, Transition]) -> None:
    """Start, age, horizon and the continuation across segments, from what the state itself remembers."""
    env, batch = recorded
    number, steps = batch.obs[..., 0], batch.obs[..., 1]
    np.testing.assert_array_equal(number, batch.start)
    np.testing.assert_array_equal(steps[0], 0)
    np.testing.assert_array_equal(steps[1:], np.where(batch.done[:-1], 0, steps[:-1] + 1))
    assert np.all((number[1:] == number[:-1]) | batch.done[:-1])
    np.testing.assert_array_equal(batch.done, batch.terminal | (steps + 1 == TASK.horizon))
    assert steps.max() == TASK.horizon - 1 > 2 * LENGTH
    # the environments handed to the next segment
    np.testing.assert_array_equal(env.age, np.where(batch.done[-1], 0, steps[-1] + 1))
    np.testing.assert_array_equal(env.obs[:, 0], env.start)
    np.testing.assert_array_equal(env.obs[:, 1], env.age)
    np.testing.assert_array_equal(env.physics.qpos[:, 2], env.age)
    # V(s_{t+1}) belongs to the state before a reset; a step into non-finite physics stays where it was
    np.testing.assert_array_equal(batch.next_obs[..., 1], steps + ~batch.bad)
    assert np.abs(batch.action).max() > 2.0  # as sampled, not clipped


def test_ends_of_episodes(recorded: tuple[EnvState, Transition]) -> None:
    """Goal, failure, bad physics, horizon: what the tosses say is what the transitions say."""
    env, batch = recorded
    action, steps = batch.action[..., 0], batch.obs[..., 1]
    success = action > stats.norm.isf([0.01, 0.05, 0.2, 0.5])[batch.start]
    failure = action < stats.norm.ppf(0.03)
    bad = (action < stats.norm.ppf(0.05)) & ~failure
    late = (steps == TASK.horizon - 1) & ~success & ~failure & ~bad
    for kind in (success, failure, bad, late):
        assert kind.sum() > 20
    np.testing.assert_array_equal(batch.reward, success)
    np.testing.assert_array_equal(batch.bad, bad)
    np.testing.assert_array_equal(batch.terminal, success | failure | bad)
    np.testing.assert_array_equal(batch.done, success | failure | bad | late)
    for leaf in jax.tree.leaves((env, batch)):
        assert np.all(np.isfinite(leaf))


def test_bad_physics_in_the_goal_is_no_success() -> None:
    """A bad step keeps the old state. If that one lies in the goal, it still does not count as reaching it."""
    task = Coin([0.0], nonfinite=1.0, horizon=5)
    goal = make_starts([[0.0, 1.0, 0.0]])
    _, batch = run(task, jax.random.key(0), goal, num_envs=4, length=3)
    assert np.all(batch.bad)
    assert np.all(batch.terminal)
    assert np.all(batch.done)
    assert not np.any(batch.reward)
    labels = label_starts(batch, 1)
    assert labels.successes[0] == 0


# ------------------------------------------------------------------------------------------------------- resets


def test_resets_draw_fresh_starts_uniformly() -> None:
    """Many successive episodes of few environments: all valid starts occur equally often, one after any other."""
    task = Coin([0.5] * 8, horizon=2)
    valid = np.array([1, 1, 0, 1, 0, 1, 1, 1], bool)
    starts = task.starts(valid=valid)
    _, batch = to_numpy(run(task, jax.random.key(4), starts, num_envs=5, length=2_000))
    after = batch.start[1:][batch.done[:-1]]
    counts = np.bincount(after, minlength=8)
    assert np.all(counts[~valid] == 0)
    assert stats.chisquare(counts[valid]).pvalue > 1e-3
    # independent of the start before it
    before = batch.start[:-1][batch.done[:-1]]
    table = np.zeros((8, 8))
    np.add.at(table, (before, after), 1)
    assert stats.chi2_contingency(table[valid][:, valid]).pvalue > 1e-3
    # and of the other environments' draws
    assert not np.array_equal(batch.start[:, 0], batch.start[:, 1])
