"""SampleNearby, select, the replay, and drawing rows of a start set."""

from __future__ import annotations

import dataclasses
import re
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy import stats

from rcg_jax import make_task
from rcg_jax import sample_nearby as sample_nearby_in_rounds
from rcg_jax.curriculum.replay import append, distinct, init_replay
from rcg_jax.curriculum.sample_nearby import visit_nearby
from rcg_jax.curriculum.select import difficulty
from rcg_jax.curriculum.settle import num_settle_candidates, settle, settled
from rcg_jax.curriculum.spread import farthest_rows, nearest_rows
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, StartLabels, StartSet, concatenate, sample_rows, sample_starts
from tests.analytic import Line, make_starts

#: Walks from the seeds only, which most tests are about.
sample_nearby = partial(sample_nearby_in_rounds, walk_rounds=1)


def tagged(num: int, x: float = 0.0) -> StartSet:
    """Starts of :class:`Line` at x, told apart by their tag."""
    return make_starts(np.stack([np.full(num, x), np.zeros(num), np.arange(num)], axis=1))


# -------------------------------------------------------------------------------------------------- sample_nearby


def all_candidates(task: Task, key: Array, seeds: StartSet, *, walks: int, steps: int, **kwargs: Any) -> np.ndarray:
    """Every state that SampleNearby had to choose from: it draws without replacement, and here as many as there are.

    Rows are repeated from the beginning where walks ended early, so duplicates are taken out.
    """
    starts = sample_nearby(
        task,
        key,
        seeds,
        num_new=seeds.capacity + walks * steps,
        num_candidates=walks * steps,
        brownian_horizon=steps,
        **kwargs,
    )
    assert np.all(starts.valid)
    return np.unique(np.asarray(starts.qpos), axis=0)


def test_candidates_are_the_seeds_and_every_step_of_every_walk() -> None:
    """W walks begin in different seeds; clock and tag tell which states came out."""
    task = Line(feasible_radius=100.0)
    seeds = tagged(6)
    qpos = all_candidates(task, jax.random.key(0), seeds, walks=4, steps=5)
    tag, clock = qpos[:, 2], qpos[:, 1]
    assert len(qpos) == 6 + 4 * 5
    np.testing.assert_array_equal(np.sort(tag[clock == 0]), np.arange(6))
    walked = np.unique(tag[clock > 0])
    assert len(walked) == 4
    for t in walked:
        np.testing.assert_array_equal(np.sort(clock[(tag == t) & (clock > 0)]), np.arange(1, 6))


@pytest.mark.parametrize(("rounds", "depth"), [(1, 1), (2, 2), (6, 6), (99, 6)])
def test_walks_of_a_round_go_on_from_what_earlier_rounds_visited(rounds: int, depth: int) -> None:
    """Procedure 1 appends what a walk visits to the list that the next walk begins in; the clock runs on."""
    task = Line(feasible_radius=100.0)
    clocks = []
    for seed in range(20):
        starts = sample_nearby_in_rounds(
            task,
            jax.random.key(seed),
            tagged(1),
            num_new=1 + 6 * 5,
            num_candidates=6 * 5,
            brownian_horizon=5,
            walk_rounds=rounds,
        )
        assert np.all(starts.valid)
        clocks.append(np.sort(np.asarray(starts.qpos)[:, 1]))
    clocks = np.array(clocks)
    assert np.all(clocks[:, 0] == 0)  # the seed is still among them
    assert clocks.max() <= depth * 5
    assert (clocks.max() > 5) == (rounds > 1)
    if rounds >= 6:  # one walk a round: each begins anywhere in the list so far, the second on average at clock 2.5
        first_two = [sorted(set(c))[:6] for c in clocks]
        assert all(f == [0, 1, 2, 3, 4, 5] for f in first_two)
        assert 8 < clocks.max(axis=1).mean() < 20


def test_new_starts_are_a_random_sample_without_replacement() -> None:
    task = Line(feasible_radius=100.0)
    nearby = partial(sample_nearby, task, num_new=40, num_candidates=100, brownian_horizon=10)
    clocks = []
    for seed in range(50):
        starts = nearby(jax.random.key(seed), tagged(10))
        assert len(np.unique(np.asarray(starts.qpos), axis=0)) == 40
        clocks.append(np.asarray(starts.qpos)[:, 1])
    # 10 seeds with clock 0 and 10 states of each later clock
    assert stats.chisquare(np.bincount(np.concatenate(clocks).astype(int), minlength=11)).pvalue > 1e-3


@pytest.mark.parametrize("name", ["feasible_radius", "fail_above", "bad_above"])
def test_a_walk_is_over_where_it_leaves(name: str) -> None:
    """Nothing is kept from the first infeasible, failed or non-finite state on, even if the walk comes back."""
    limit = 0.15
    limits: dict[str, Any] = {"feasible_radius": 100.0, name: limit}
    task = Line(gain=0.1, **limits)
    seeds = tagged(200)
    qpos = all_candidates(task, jax.random.key(0), seeds, walks=200, steps=15, noise="white")
    assert qpos[:, 0].max() <= limit
    if name == "feasible_radius":
        assert qpos[:, 0].min() >= -limit
    lengths = []
    for t in range(200):
        walk = qpos[qpos[:, 2] == t]
        walk = walk[np.argsort(walk[:, 1])]
        # Without a gap: a walk that came back in would leave one.
        np.testing.assert_array_equal(walk[:, 1], np.arange(len(walk)))
        lengths.append(len(walk) - 1)
        # A walk that ended early was one step from the limit: it did not go on after a step that did not count.
        last = abs(walk[-1, 0]) if name == "feasible_radius" else walk[-1, 0]
        assert len(walk) == 16 or last > limit - task.gain - 1e-6
    assert min(lengths) < 15
    assert max(lengths) == 15


def test_passing_through_the_goal_does_not_end_a_walk() -> None:
    task = Line(gain=0.1, goal_radius=0.1, feasible_radius=100.0)
    assert len(all_candidates(task, jax.random.key(0), tagged(20), walks=20, steps=10)) == 20 * 11


@pytest.mark.parametrize("noise", ["white", "integrated"])
@pytest.mark.parametrize("order", [1, 2])
def test_spread_of_the_walks(noise: str, order: int) -> None:
    """Variance of x after t steps: each eps acts on all later steps, once more per integration.

    White velocities: t. White accelerations, or Brownian velocities: sums of squares. Brownian accelerations: more.
    """
    gain, std, steps, walks = 0.01, 0.02, 12, 3_000  # small: actions are never clipped
    task = Line(gain=gain, order=order, feasible_radius=100.0)
    qpos = all_candidates(task, jax.random.key(3), tagged(walks), walks=walks, steps=steps, noise=noise, noise_std=std)
    response = np.eye(steps)[0]
    for _ in range(order + (noise == "integrated")):
        response = np.cumsum(response)
    for t in range(1, steps + 1):
        x = qpos[qpos[:, 1] == t, 0]
        assert len(x) == walks
        expected = std * gain**order * np.sqrt(np.sum(response[:t] ** 2))
        # the sample's standard deviation is known to 1 / sqrt(2 walks)
        assert abs(x.std() / expected - 1) < 4.5 / np.sqrt(2 * walks)
        assert abs(x.mean()) < 4.5 * expected / np.sqrt(walks)


def test_walks_longer_than_what_is_kept_of_them() -> None:
    """Of longer walks still T_B states: every step at first, then at growing intervals, the last one included.

    The length is traced, so one program serves all.
    """
    task = Line(feasible_radius=100.0)

    @jax.jit
    def nearby(walk_length: Array) -> StartSet:
        return visit_nearby(
            task,
            jax.random.key(0),
            tagged(8),
            num_candidates=80,
            num_snapshots=10,
            walk_length=walk_length,
            walk_rounds=1,
            noise_std=1.0,
            noise="integrated",
        )

    times = {
        10: [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
        30: [0, 1, 2, 3, 4, 5, 8, 11, 15, 21, 30],  # 30 ** (6 / 10) = 7.7
        400: [0, 2, 3, 6, 11, 20, 36, 66, 121, 220, 400],
    }
    for length, expected in times.items():
        qpos = np.unique(np.asarray(nearby(jnp.int32(length)).qpos), axis=0)
        for t in range(8):
            np.testing.assert_array_equal(np.sort(qpos[qpos[:, 2] == t, 1]), expected)


def test_invalid_seeds_are_never_used() -> None:
    """Whatever is in their rows."""
    task = Line(feasible_radius=100.0)
    qpos = np.array([[np.nan, 0, 0], [0, 0, 1], [50.0, 0, 2], [0, 0, 3]])
    seeds = make_starts(qpos, valid=[False, True, False, True])
    starts = sample_nearby(task, jax.random.key(0), seeds, num_new=100, num_candidates=200, brownian_horizon=10)
    assert np.all(starts.valid)
    assert set(np.asarray(starts.qpos)[:, 2]) == {1.0, 3.0}
    assert np.all(np.isfinite(starts.qpos))


class Slope(Line):
    """A hilltop at 0: without any action x grows by a tenth in every step, so that only what is near the top stays."""

    settle_steps = 8

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        moved = super().step(state, action)
        return moved.replace(qpos=moved.qpos.at[:, 0].add(0.1 * state.qpos[:, 0]))


def stays_on_slope(x: np.ndarray) -> np.ndarray:
    """|x| < 1 for all of the 8 steps."""
    return np.abs(x) * 1.1**8 < 1


def test_settling_is_staying_feasible_all_the_time() -> None:
    """Against the closed form; the clock is a grid coordinate, too, and drifts by 1 per step."""
    x = np.linspace(-1.2, 1.2, 97)
    starts = make_starts(np.stack([x, np.zeros(97), np.zeros(97)], axis=1))
    stays, drift = settle(Slope(), starts, 8)
    np.testing.assert_array_equal(stays, stays_on_slope(x))
    assert 0 < np.sum(stays) < 97
    np.testing.assert_allclose(drift, 8)
    stays, _ = settle(Slope(fail_above=0.3), starts, 8)
    np.testing.assert_array_equal(stays, stays_on_slope(x) & (x * 1.1**8 <= 0.3))


def test_the_first_that_settle_are_taken_in_their_order() -> None:
    x, valid = np.array([0.9, 0.1, 0.8, 0.2, 0.3, 0.7, 0.4, 0.99]), np.ones(8, bool)
    valid[3] = False
    starts = make_starts(np.stack([x, np.zeros(8), np.arange(8)], axis=1), valid=valid)
    assert num_settle_candidates(Slope(), 4) == 8
    few = settled(Slope(), starts, 2)
    np.testing.assert_array_equal(few.qpos[:, 2], [1, 4])
    assert np.all(few.valid)
    more = settled(Slope(), starts, 4)  # only three stay: the first is there twice
    np.testing.assert_array_equal(more.qpos[:, 2], [1, 4, 6, 1])
    assert np.all(more.valid)
    none = settled(Slope(), starts.take(jnp.array([0, 2, 3, 7])), 2)
    assert not np.any(none.valid)


def test_spread_rows_are_each_the_farthest_from_those_before() -> None:
    """Against a loop in NumPy; invalid rows, whatever they hold, are taken only when nothing else is left."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3)).astype(np.float32)
    valid = rng.random(60) < 0.7
    points[~valid] = np.nan
    first = int(np.flatnonzero(valid)[5])
    expected = [first]
    while len(expected) < valid.sum():
        distance = np.linalg.norm(points[:, None] - points[expected], axis=-1).min(axis=1)
        distance[~valid] = -1.0
        distance[expected] = -1.0
        expected.append(int(np.argmax(distance)))
    rows = np.asarray(
        jax.jit(partial(farthest_rows, num=60))(jnp.asarray(points), jnp.asarray(valid), jnp.int32(first))
    )
    np.testing.assert_array_equal(rows[: len(expected)], expected)
    assert not valid[rows[len(expected) :]].any()


def test_nearest_rows_are_each_the_nearest_that_is_left() -> None:
    """Against a loop in NumPy; invalid rows, whatever they hold, are taken only when nothing else is left."""
    rng = np.random.default_rng(1)
    points, targets = rng.normal(size=(30, 3)).astype(np.float32), rng.normal(size=(25, 3)).astype(np.float32)
    valid = rng.random(30) < 0.7
    points[~valid] = np.nan
    free = list(np.flatnonzero(valid))
    expected = []
    for target in targets[: len(free)]:
        expected.append(min(free, key=lambda row: float(np.sum((points[row] - target) ** 2))))
        free.remove(expected[-1])
    assert not free, "more targets than valid rows"
    rows = np.asarray(jax.jit(nearest_rows)(jnp.asarray(points), jnp.asarray(valid), jnp.asarray(targets)))
    np.testing.assert_array_equal(rows[: len(expected)], expected)
    assert len(expected) < len(rows) == len(set(rows))
    assert not valid[rows[len(expected) :]].any()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"num_new": 0}, "num_new=0: must be an integer >= 1"),
        ({"num_new": 1.5}, "num_new=1.5: must be an integer >= 1"),
        ({"num_candidates": 0}, "num_candidates=0: must be an integer >= 1"),
        ({"brownian_horizon": -1}, "brownian_horizon=-1: must be an integer >= 1"),
        ({"walk_rounds": 0}, "walk_rounds=0: must be an integer >= 1"),
        ({"noise_std": 0.0}, "noise_std=0.0: must be a finite number > 0"),
        ({"noise_std": float("nan")}, "noise_std=nan: must be a finite number > 0"),
        ({"selection": "best"}, "selection=best: must be one of random, spread"),
        ({"noise": "pink"}, "noise=pink: must be one of white, integrated"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, Any], says: str) -> None:
    task = Line()
    with pytest.raises(ValueError, match=re.escape(says)):
        sample_nearby_in_rounds(task, jax.random.key(0), task.goal_starts(), **wrong)


def test_no_valid_seed_gives_no_valid_start() -> None:
    task = Line()
    seeds = make_starts(np.zeros((3, 3)), valid=np.zeros(3))
    starts = sample_nearby(task, jax.random.key(0), seeds, num_new=10, num_candidates=20, brownian_horizon=5)
    assert starts.capacity == 10
    assert not np.any(starts.valid)


def test_sample_nearby_on_ring_peg_native(ring_peg_native: Task) -> None:
    """Starts near the goal of a real task: valid, feasible, at rest, moved, and all different."""
    task = ring_peg_native

    def near(key: Array) -> StartSet:
        return sample_nearby(task, key, task.goal_starts(), num_new=50, num_candidates=8 * 20, brownian_horizon=20)

    starts = near(jax.random.key(0))
    assert np.all(starts.valid)
    assert not np.any(starts.qvel)
    assert np.all(jax.jit(jax.vmap(task.is_feasible))(jax.jit(task.snapshot)(task.reset(starts))))
    assert len(np.unique(np.asarray(starts.qpos), axis=0)) == 50
    moved = np.abs(np.asarray(starts.qpos) - np.asarray(task.goal_starts().qpos)).max(axis=1)
    assert 0.01 < np.median(moved) < 2.0
    jax.tree.map(np.testing.assert_array_equal, near(jax.random.key(0)), starts)


# --------------------------------------------------------------------------------------------------------- select


def labels(successes: Any, episodes: Any) -> StartLabels:
    successes, episodes = (jnp.asarray(x, jnp.int32) for x in (successes, episodes))
    return StartLabels(successes=successes, episodes=episodes, steps=successes)


def test_select_keeps_starts_within_the_bounds_inclusively() -> None:
    starts = make_starts(np.arange(18).reshape(6, 3))
    outcome = labels([0, 1, 5, 9, 10, 3], [10, 10, 10, 10, 10, 0])
    kind = difficulty(starts, outcome, r_min=0.1, r_max=0.9, min_episodes=1)
    np.testing.assert_array_equal(kind.low, [True, False, False, False, False, False])
    np.testing.assert_array_equal(kind.good, [False, True, True, True, False, False])
    np.testing.assert_array_equal(kind.high, [False, False, False, False, True, False])


def test_bounds_are_inclusive_for_every_number_of_episodes() -> None:
    """k / n compared with r = k / n written as a decimal: rounding must not decide."""
    episodes = np.array([(k * m, n * m) for k, n in ((1, 10), (9, 10), (1, 4), (1, 2), (3, 10)) for m in range(1, 60)])
    rates = np.repeat([0.1, 0.9, 0.25, 0.5, 0.3], 59)
    starts = make_starts(np.zeros((1, 3)))
    check = jax.jit(lambda k, n, low, high: difficulty(starts, labels(k, n), r_min=low, r_max=high, min_episodes=1))
    for (k, n), rate in zip(episodes, rates, strict=True):
        assert check(k[None], n[None], rate, rate).good[0], (k, n)


def test_too_few_episodes_and_invalid_rows_are_in_no_class() -> None:
    starts = make_starts(np.zeros((5, 3)), valid=[True, True, True, False, True])
    outcome = labels([0, 1, 2, 2, 3], [1, 2, 4, 4, 3])
    kind = difficulty(starts, outcome, r_min=0.1, r_max=0.9, min_episodes=3)
    np.testing.assert_array_equal(kind.low, [False] * 5)
    np.testing.assert_array_equal(kind.good, [False, False, True, False, False])
    np.testing.assert_array_equal(kind.high, [False, False, False, False, True])


# --------------------------------------------------------------------------------------------------------- replay


def numbered(first: int, num: int, valid: Any = None) -> StartSet:
    """Starts that carry numbers, in every component."""
    number = np.arange(first, first + num, dtype=float)
    starts = make_starts(np.stack([number] * 3, axis=1), valid=valid)
    return dataclasses.replace(starts, qvel=starts.qpos[:, :1])


def numbers(starts: StartSet) -> np.ndarray:
    """The numbers of the valid starts; none may be a mixture of two."""
    qpos = np.asarray(starts.qpos)[np.asarray(starts.valid)]
    assert np.all(qpos == qpos[:, :1])
    np.testing.assert_array_equal(np.asarray(starts.qvel)[np.asarray(starts.valid), 0], qpos[:, 0])
    return qpos[:, 0].astype(int)


push = jax.jit(append)


def test_replay_fills_in_order_with_valid_starts_only() -> None:
    replay = init_replay(numbered(0, 1), 8)
    assert replay.capacity == 8
    np.testing.assert_array_equal(numbers(replay), [0])
    replay = push(jax.random.key(0), replay, numbered(10, 4, valid=[False, True, False, True]))
    np.testing.assert_array_equal(numbers(replay), [0, 11, 13])
    replay = push(jax.random.key(1), replay, numbered(20, 4, valid=[False] * 4))
    np.testing.assert_array_equal(numbers(replay), [0, 11, 13])
    replay = push(jax.random.key(2), replay, numbered(30, 5))  # exactly full
    np.testing.assert_array_equal(numbers(replay), [0, 11, 13, 30, 31, 32, 33, 34])


@pytest.mark.parametrize("before", [3, 5, 6, 8])
def test_a_full_replay_forgets_old_starts_for_every_new_one(before: int) -> None:
    """All new starts are in it afterwards, also where they come to its last free rows; the rest are old ones."""
    for seed in range(40):
        replay = init_replay(numbered(0, before), 8)
        replay = push(jax.random.key(seed), replay, numbered(100, 6, valid=[1, 1, 0, 1, 1, 1]))
        kept = numbers(replay)
        assert len(kept) == 8
        assert len(set(kept)) == 8
        assert {100, 101, 103, 104, 105} < set(kept)
        assert set(kept) - {100, 101, 103, 104, 105} <= set(range(before))


def test_replaced_starts_are_uniform() -> None:
    keys = jax.random.split(jax.random.key(0), 2_000)
    replay = init_replay(numbered(0, 8), 8)
    after = jax.jit(jax.vmap(append, in_axes=(0, None, None)))(keys, replay, numbered(100, 3))
    gone = np.bincount(np.argwhere(np.asarray(after.qpos)[:, :, 0] >= 100)[:, 1], minlength=8)
    assert gone.sum() == 3 * 2_000
    assert stats.chisquare(gone).pvalue > 1e-3


# ---------------------------------------------------------------------------------------------------- sample_rows


def test_rows_are_drawn_without_replacement_from_valid_ones() -> None:
    valid = np.arange(20) % 4 == 1
    starts = numbered(0, 20, valid=valid)
    firsts = []
    for seed in range(300):
        rows = np.asarray(sample_rows(jax.random.key(seed), starts, 3))
        assert len(set(rows)) == 3
        assert np.all(valid[rows])
        firsts.append(rows[0])
    counts = np.bincount(firsts, minlength=20)[valid]
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize(("num", "expected"), [(5, {1}), (7, {1, 2}), (10, {2}), (23, {4, 5})])
def test_rows_repeat_equally_often_where_there_are_too_few(num: int, expected: set[int]) -> None:
    starts = numbered(0, 20, valid=np.arange(20) % 4 == 1)
    rows = np.asarray(sample_rows(jax.random.key(0), starts, num))
    assert rows.shape == (num,)
    counts = np.bincount(rows, minlength=20)
    assert set(counts[1::4]) == expected
    assert counts.sum() == counts[1::4].sum()


def test_rows_of_an_empty_set_are_invalid() -> None:
    starts = numbered(0, 6, valid=np.zeros(6))
    assert not np.any(sample_starts(jax.random.key(0), starts, 4).valid)
    assert sample_starts(jax.random.key(0), starts, 0).capacity == 0


def test_concatenate_keeps_order_and_masks() -> None:
    both = concatenate(numbered(0, 2, valid=[True, False]), numbered(5, 3))
    np.testing.assert_array_equal(both.valid, [True, False, True, True, True])
    np.testing.assert_array_equal(numbers(both), [0, 5, 6, 7])
    assert both.count() == 4


@pytest.mark.slow
def test_sample_nearby_inside_other_transformations() -> None:
    """In somebody else's jit, vmap, scan and grad it gives what it gives alone."""
    task = make_task("point_maze", engine="native")

    def near(key: Array, scale: Any = 1.0) -> Array:
        goal = task.goal_starts()
        goal = dataclasses.replace(goal, qpos=scale * goal.qpos)
        sizes = {"num_new": 8, "num_candidates": 20, "brownian_horizon": 5}
        return sample_nearby_in_rounds(task, key, goal, walk_rounds=2, **sizes).qpos

    key = jax.random.key(3)
    alone = np.asarray(near(key))
    keys = jnp.stack([jax.random.key(2), key])
    found = {
        "vmap": jax.vmap(near)(keys)[1],
        "jit of scan": jax.jit(lambda k: jax.lax.scan(lambda c, k: (c, near(k)), 0, k)[1])(keys)[1],
    }
    for how, qpos in found.items():
        np.testing.assert_array_equal(qpos, alone, err_msg=how)
    np.testing.assert_allclose(jax.grad(lambda w: jnp.sum(w * near(key, w)))(1.0), alone.sum(), rtol=1e-6)


def test_only_distinct_starts_enter_a_replay_that_keeps_a_distance() -> None:
    """Against a loop over the starts in order."""
    rng = np.random.default_rng(0)
    old, new = rng.uniform(size=(20, 2)), rng.uniform(size=(30, 2))
    here, usable = np.arange(20) < 12, rng.uniform(size=30) < 0.8
    kept, wanted = list(old[here]), []
    for point, usable_one in zip(new, usable, strict=True):
        wanted.append(bool(usable_one) and all(np.linalg.norm(point - other) > 0.15 for other in kept))
        if wanted[-1]:
            kept.append(point)
    found = jax.jit(distinct, static_argnums=2)(make_starts(old, valid=here), make_starts(new, valid=usable), 0.15)
    assert found.valid.tolist() == wanted
    assert 0 < sum(wanted) < usable.sum()
