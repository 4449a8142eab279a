"""The curriculum's state from one iteration to the next, with labels written by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy import stats

from rcg_jax.config.names import METHODS as METHOD_NAMES
from rcg_jax.config.settings import Config, CurriculumConfig
from rcg_jax.methods import METHODS, make_method
from rcg_jax.methods.base import MethodMetrics
from rcg_jax.methods.reverse import Reverse, ReverseState
from rcg_jax.rl.agent import init_agent, make_baseline
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.types import PhysicsState, Snapshot, StartLabels, StartSet
from tests.analytic import ExactLine, Line, make_starts

NEW, OLD = 12, 6
TASK = Line(gain=0.1, feasible_radius=2.0)
CONFIG = CurriculumConfig(
    num_new=NEW,
    num_old=OLD,
    num_candidates=100,
    brownian_horizon=10,
    brownian_horizon_max=25,
    selection="random",
    noise_std=1.0,
    noise="integrated",
    r_min=0.1,
    r_max=0.9,
    min_episodes=2,
    min_good=0.2,
    outward_share=1.0,
    replay_capacity=40,
)

#: Outcomes of one start: (successes, episodes).
HARD, GOOD, MASTERED, UNKNOWN = (0, 10), (5, 10), (10, 10), (1, 1)


class Track(Line):
    """A line whose positions are compared by x alone."""

    def grid_coordinates(self, qpos: Any) -> Any:
        return qpos[:, :1]


class Compiled:
    """A method that asks nothing of the agent, with its functions compiled; proposing leaves its state as it was."""

    def __init__(self, method: Any) -> None:
        self.init = method.init
        self.propose = jax.jit(lambda key, state: method.propose(key, state, None)[1])
        self.update = jax.jit(method.update)


REVERSE = Compiled(Reverse(TASK, Config(curriculum=CONFIG)))


def outcomes(kinds: Any) -> StartLabels:
    """Labels of given (successes, episodes), each success after 7 steps."""
    successes, episodes = np.array(kinds).T
    return StartLabels(
        successes=jnp.asarray(successes), episodes=jnp.asarray(episodes), steps=jnp.asarray(7 * successes)
    )


def positions(starts: StartSet) -> set[float]:
    """Where the valid starts are; Brownian walks make positions unique, up to clipping."""
    return set(np.asarray(starts.qpos)[np.asarray(starts.valid), 0].tolist())


def begin(seed: int = 0) -> tuple[ReverseState, StartSet]:
    """A curriculum in its second iteration: the replay holds the goal and a few good starts."""
    state = REVERSE.init(jax.random.key(seed))
    starts = REVERSE.propose(jax.random.key(seed + 1), state)
    kinds = np.array([GOOD] * 4 + [MASTERED] * (NEW - 4) + [MASTERED] * OLD)
    state, _ = REVERSE.update(jax.random.key(seed + 2), state, starts, outcomes(kinds))
    return state, REVERSE.propose(jax.random.key(seed + 3), state)


def check_proposal(state: ReverseState) -> None:
    """Whatever happened, there is something to train on."""
    starts = REVERSE.propose(jax.random.key(9), state)
    assert starts.capacity == NEW + OLD
    assert np.all(starts.valid)
    assert np.all(np.abs(starts.qpos[:, 0]) < TASK.feasible_radius)
    assert not np.any(starts.qvel)


def update(kinds: Any, seed: int = 0) -> tuple[ReverseState, StartSet, ReverseState, Any]:
    """(state before, its starts, state after, metrics) for the given outcomes of the starts."""
    before, starts = begin(seed)
    after, metrics = REVERSE.update(jax.random.key(seed + 4), before, starts, outcomes(kinds))
    check_proposal(after)
    return before, starts, after, metrics


# -------------------------------------------------------------------------------------------------------- reverse


@pytest.mark.slow
@pytest.mark.parametrize("value_share", [0.0, 0.5, 1.0])
def test_new_starts_cover_what_the_walks_visited(value_share: float) -> None:
    """One part evenly over the positions, one over V: no visited state is farther from them than range / number.

    That is twice what the best choice of so few points on a line reaches, the bound of the farthest-first rule. Most
    visited states are near the goal, so random ones miss it by far.
    """
    num = 20
    task = Track(gain=0.1, feasible_radius=2.0)

    config = Config()
    agent = init_agent(config, jax.random.key(1), task.obs_dim, task.action_dim)

    def proposed(selection: str, num_new: int = num) -> StartSet:
        curriculum = dataclasses.replace(
            CONFIG, selection=selection, value_share=value_share, num_new=num_new, num_old=0, num_candidates=2_000
        )
        method = Reverse(task, Config(curriculum=dataclasses.replace(curriculum, replay_capacity=4_000)))
        return jax.jit(method.propose)(jax.random.key(2), method.init(jax.random.key(0)), agent)[1]

    # The same walks each time; the last draws every state, without replacement and then again.
    starts, crowd, visited = proposed("spread"), proposed("random"), proposed("random", num_new=3_000)

    def value(s: StartSet) -> np.ndarray:
        return np.asarray(make_baseline(config)(agent.baseline, task.observe_batch(task.reset(s))))

    def position(s: StartSet) -> np.ndarray:
        return np.asarray(s.qpos)[:, 0]

    by_value = round(value_share * num)
    for coordinate, rows in ((value, np.arange(by_value)), (position, np.arange(by_value, num))):
        if not len(rows):
            continue
        among = coordinate(visited)

        def gap(s: StartSet, among: np.ndarray = among, coordinate: Any = coordinate, rows: Any = rows) -> float:
            return np.abs(among[:, None] - coordinate(s)[rows]).min(axis=1).max()

        assert gap(starts) <= np.ptp(among) / len(rows) + 1e-6
        assert gap(crowd) > np.ptp(among) / len(rows)


class FarAway(Track):
    """rho_0 lies on one side of the goal, further than walks get; the policy sees the clock, too."""

    def observe(self, s: Snapshot) -> Array:
        return s.qpos[:2]

    def sample_feasible(self, key: Array, num: int) -> StartSet:
        return make_starts(jnp.pad(jax.random.uniform(key, (num, 1), minval=50.0, maxval=60.0), ((0, 0), (0, 2))))


@pytest.mark.slow
@pytest.mark.parametrize("selection", ["random", "spread"])
def test_a_share_of_the_new_starts_is_nearest_to_rho_0(selection: str) -> None:
    """All draws of rho_0 lie beyond what is visited, on one side: that share are the states furthest on that side."""
    task, num, towards = FarAway(gain=0.1, feasible_radius=100.0), 20, 5
    agent = init_agent(Config(), jax.random.key(1), task.obs_dim, task.action_dim)
    # Draws of rho_0 have the clock at 0; as the policy sees it, it hardly moves.
    agent = dataclasses.replace(agent, norm=agent.norm.replace(var=jnp.array([1.0, 1e6])))

    def proposed(num_new: int = num, num_old: int = 0, **settings: Any) -> np.ndarray:
        # value_share=1: of those that are not for rho_0.
        settings = {"num_candidates": 1_000, "replay_capacity": 4_000, "value_share": 1.0, **settings}
        curriculum = dataclasses.replace(CONFIG, num_new=num_new, num_old=num_old, **settings)
        method = Reverse(task, Config(curriculum=curriculum))
        starts = jax.jit(method.propose)(jax.random.key(2), method.init(jax.random.key(0)), agent)[1]
        assert starts.capacity == num_new
        assert np.all(starts.valid)
        return np.asarray(starts.qpos)[:, 0]

    # Three times as many draws as there are states visited: each is among them. Two walks may end at the same position.
    visited = np.unique(proposed(num_new=3_000, selection="random"))
    frontier = visited[-towards:]

    def check_frontier(taken: np.ndarray) -> None:
        distinct = np.unique(taken)
        assert len(distinct) >= 0.8 * len(taken)
        np.testing.assert_array_equal(distinct, visited[-len(distinct) :])

    assert not set(frontier) <= set(proposed(selection=selection))
    biased = proposed(selection=selection, rho_0_share=towards / num)
    check_frontier(biased[:towards])
    assert np.ptp(biased[towards:]) > np.ptp(frontier), "the others as before"
    check_frontier(proposed(selection=selection, rho_0_share=1.0))


def test_training_begins_around_the_goal() -> None:
    state = REVERSE.init(jax.random.key(0))
    assert positions(state.seeds) == {0.0}
    assert positions(state.replay) == {0.0}
    starts = REVERSE.propose(jax.random.key(1), state)
    check_proposal(state)
    # Walks of at most T_B steps of gain 0.1; the replay has but the goal.
    assert np.all(np.abs(starts.qpos[:NEW, 0]) <= 0.1 * CONFIG.brownian_horizon + 1e-6)
    assert len(positions(starts.take(jnp.arange(NEW)))) > NEW // 2
    assert not np.any(starts.qpos[NEW:])


def test_good_starts_are_the_next_seeds_and_remembered() -> None:
    kinds = [GOOD] * 7 + [HARD] * 4 + [MASTERED] * 5 + [UNKNOWN] * 2
    before, starts, after, metrics = update(kinds)
    good = positions(starts.take(jnp.arange(7)))
    assert positions(after.seeds) == good
    assert positions(after.replay) == positions(before.replay) | good
    assert int(after.replay.count()) == int(before.replay.count()) + 7
    np.testing.assert_allclose(metrics.share_good, 7 / 16)
    np.testing.assert_allclose(metrics.share_low, 4 / 16)
    np.testing.assert_allclose(metrics.share_high, 5 / 16)
    np.testing.assert_allclose(metrics.labelled, 16 / 18)


def test_new_starts_come_from_the_seeds_and_old_ones_from_the_replay() -> None:
    _, _, after, _ = update([GOOD] * 9 + [HARD] * 9)
    starts = REVERSE.propose(jax.random.key(0), after)
    assert positions(starts.take(jnp.arange(NEW, NEW + OLD))) <= positions(after.replay)
    seeds = np.array(sorted(positions(after.seeds)))
    distance = np.abs(np.asarray(starts.qpos)[:NEW, :1] - seeds).min(axis=1)
    assert np.all(distance <= 0.1 * float(after.walk_length) + 1e-5)


@pytest.mark.parametrize(
    ("kinds", "kept", "replayed"),
    [
        # The frontier: new mastered starts, and not the replayed ones.
        ([MASTERED] * (NEW + OLD), range(NEW), False),
        # No new start was labelled at all, so there is no frontier to prefer.
        ([UNKNOWN] * NEW + [MASTERED] * OLD, range(NEW + OLD), False),
        # Few good, most mastered: both.
        ([GOOD] + [MASTERED] * 8 + [HARD] * 3 + [MASTERED] * OLD, range(9), False),
        ([HARD] * (NEW + OLD), (), True),
        ([UNKNOWN] * (NEW + OLD), (), True),
    ],
)
def test_what_comes_next_where_few_or_none_are_good(kinds: Any, kept: Any, replayed: bool) -> None:
    before, starts, after, metrics = update(kinds)
    rows = np.array(kept, int)
    expected = positions(starts.take(jnp.asarray(rows))) if len(rows) else set()
    assert positions(after.seeds) == expected | (positions(before.replay) if replayed else set())
    if replayed:
        jax.tree.map(np.testing.assert_array_equal, after.replay, before.replay)
    of = {kind: kinds.count(kind) for kind in (HARD, GOOD, MASTERED)}
    shares = (metrics.share_low, metrics.share_good, metrics.share_high)
    labelled = sum(of.values())
    np.testing.assert_allclose(metrics.labelled, labelled / (NEW + OLD))
    np.testing.assert_allclose(shares, np.array(list(of.values())) / max(labelled, 1), rtol=1e-6)


def test_of_many_mastered_starts_the_slowest_lead_outwards() -> None:
    """A quarter of the 12 new ones, by time to the goal; old ones never, however slow."""
    task_config = dataclasses.replace(CONFIG, outward_share=0.25)
    before, starts = begin()
    steps = np.full(NEW + OLD, 30)
    slow = [2, 5, 9]
    steps[slow] = [80, 90, 81]
    steps[NEW:] = 200
    kinds = np.array([MASTERED] * (NEW + OLD))
    labels = StartLabels(
        successes=jnp.asarray(kinds[:, 0]), episodes=jnp.asarray(kinds[:, 1]), steps=jnp.asarray(10 * steps)
    )
    after, _ = Compiled(Reverse(TASK, Config(curriculum=task_config))).update(jax.random.key(4), before, starts, labels)
    expected = positions(starts.take(jnp.array(slow)))
    assert positions(after.seeds) == expected
    assert positions(after.replay) == positions(before.replay) | expected


def test_few_good_most_hard_adds_the_replay_to_the_good_ones() -> None:
    before, starts, after, _ = update([GOOD] + [HARD] * (NEW + OLD - 1))
    good = positions(starts.take(jnp.arange(1)))
    assert good < positions(after.seeds) <= good | positions(before.replay)
    assert positions(after.replay) == positions(before.replay) | good


def test_first_iteration_too_hard_begins_again_at_the_goal() -> None:
    """The replay holds nothing but s^g."""
    state = REVERSE.init(jax.random.key(0))
    starts = REVERSE.propose(jax.random.key(1), state)
    after, _ = REVERSE.update(jax.random.key(2), state, starts, outcomes([HARD] * (NEW + OLD)))
    assert positions(after.seeds) == positions(after.replay) == {0.0}
    check_proposal(after)


def test_paper_falls_back_only_when_none_is_good() -> None:
    """min_good = 0: a single good start is enough."""
    method = Compiled(Reverse(TASK, Config(curriculum=dataclasses.replace(CONFIG, min_good=0.0))))
    before, starts = begin()
    for other in (HARD, MASTERED):
        after, _ = method.update(jax.random.key(0), before, starts, outcomes([GOOD] + [other] * (NEW + OLD - 1)))
        assert positions(after.seeds) == positions(starts.take(jnp.arange(1)))
    after, _ = method.update(jax.random.key(0), before, starts, outcomes([HARD] * (NEW + OLD)))
    assert positions(after.seeds) == positions(before.replay)


@pytest.mark.slow
def test_a_stalled_curriculum_walks_far_with_more_noise_where_that_is_asked_for() -> None:
    """stall_walk, as in the authors' code: only where none is good and most are mastered; nothing is remembered."""
    walks = 50
    settings = dataclasses.replace(
        CONFIG, min_good=0.0, num_candidates=80 * walks, stall_walks=walks, noise="white", noise_std=0.1
    )
    near, far = (
        Compiled(Reverse(TASK, Config(curriculum=dataclasses.replace(settings, stall_walk=k)))) for k in (0, 2)
    )
    before, starts = begin()
    starts = dataclasses.replace(starts, qpos=jnp.zeros_like(starts.qpos))

    def after(method: Compiled, kinds: Any) -> tuple[ReverseState, MethodMetrics]:
        return method.update(jax.random.key(0), before, starts, outcomes(kinds))

    stalled, metrics = after(far, [MASTERED] * (NEW + OLD))
    assert stalled.seeds.count() == NEW
    visited = np.asarray(stalled.seeds.qpos[:NEW, 0])
    # A step moves by 0.1 times the noise, whose standard deviation is 0.1 sqrt(10), and walks have up to 80 of them.
    assert TASK.horizon == 40
    assert 0.5 < np.sqrt(np.mean(visited**2)) / (0.1 * 0.1 * np.sqrt(10 * 40)) < 1.5
    assert positions(stalled.replay) == positions(before.replay)
    assert metrics.proposal_steps == after(near, [MASTERED] * (NEW + OLD))[1].proposal_steps + 80 * walks
    for kinds in ([GOOD] + [MASTERED] * (NEW + OLD - 1), [HARD] * (NEW + OLD)):
        chex.assert_trees_all_equal(after(far, kinds), after(near, kinds))


@pytest.mark.slow
def test_no_combination_of_outcomes_leaves_nothing_to_train_on() -> None:
    """Random outcomes over many iterations, also without replayed starts, with a replay that overflows."""
    for num_old in (0, OLD):
        config = dataclasses.replace(CONFIG, num_old=num_old, replay_capacity=20)
        method = Compiled(Reverse(TASK, Config(curriculum=config)))
        rng = np.random.default_rng(0)
        state = method.init(jax.random.key(0))
        for i in range(40):
            starts = method.propose(jax.random.key(2 * i), state)
            assert np.all(starts.valid)
            assert np.all(np.abs(starts.qpos[:, 0]) < TASK.feasible_radius)
            weights = rng.dirichlet([0.15] * 4)
            kinds = rng.choice([HARD, GOOD, MASTERED, UNKNOWN], size=NEW + num_old, p=weights)
            state, metrics = method.update(jax.random.key(2 * i + 1), state, starts, outcomes(kinds))
            assert int(state.seeds.count()) > 0
            assert int(state.replay.count()) <= 20
            assert CONFIG.brownian_horizon <= metrics.brownian_horizon <= CONFIG.brownian_horizon_max
        assert int(state.replay.count()) == 20


def test_walks_lengthen_while_mastered_and_shorten_while_hard() -> None:
    """Within T_B and its maximum; and what is reported is what was walked."""
    state, starts = begin()
    reported = []
    for kind in [MASTERED] * 6 + [HARD] * 6 + [GOOD] * 2:
        state, metrics = REVERSE.update(jax.random.key(0), state, starts, outcomes([kind] * (NEW + OLD)))
        reported.append(float(metrics.brownian_horizon))
        assert metrics.proposal_steps == metrics.brownian_horizon * 10  # 10 walks: 100 candidates, 10 kept of each
    assert max(reported) == CONFIG.brownian_horizon_max
    assert np.all(np.diff(reported[:7]) >= 0)
    assert reported[6] > reported[0]
    assert np.all(np.diff(reported[6:]) <= 0)
    assert reported[-1] == CONFIG.brownian_horizon


@pytest.mark.parametrize(
    ("fails", "kinds", "grows"),
    [
        (True, [HARD] + [GOOD] * (NEW + OLD - 1), True),
        (True, [HARD] * 2 + [GOOD] * (NEW + OLD - 2), False),
        (False, [GOOD] * (NEW + OLD), False),
        (True, [UNKNOWN] * (NEW + OLD), False),
    ],
)
def test_walks_lengthen_while_hardly_any_start_is_too_hard(fails: bool, kinds: Any, grows: bool) -> None:
    """Where episodes can fail; one start of 18 is less than a tenth, two are more; without labels nothing is known."""
    task = Line(gain=0.1, feasible_radius=2.0, fail_above=5.0 if fails else np.inf)
    method = Compiled(Reverse(task, Config(curriculum=CONFIG)))
    state, starts = begin()
    labels = outcomes(kinds)
    before = float(state.walk_length)
    for _ in range(9):
        state, _ = method.update(jax.random.key(0), state, starts, labels)
    assert float(state.walk_length) == (CONFIG.brownian_horizon_max if grows else before)


class Ridge(Line):
    """Only what is within 0.3 of the top stays where it is."""

    settle_steps = 5

    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        moved = super().step(state, action)
        slides = jnp.abs(state.qpos[:, 0]) > self.stays_within
        return moved.replace(qpos=moved.qpos.at[:, 0].add(jnp.where(slides, 10.0, 0.0)))

    stays_within = 0.3

    def sample_feasible(self, key: Array, num: int) -> StartSet:
        """On both sides of the edge beyond which nothing stays."""
        return make_starts(jnp.pad(jax.random.uniform(key, (num, 1), minval=0.2, maxval=0.4), ((0, 0), (0, 2))))


@pytest.mark.slow
@pytest.mark.parametrize(("selection", "share"), [("random", 0.0), ("random", 1.0), ("spread", 0.5)])
def test_new_starts_settle_and_the_steps_are_counted(selection: str, share: float) -> None:
    task = Ridge(gain=0.1, feasible_radius=2.0)
    curriculum = dataclasses.replace(CONFIG, selection=selection, value_share=0.0, rho_0_share=share)
    method = Reverse(task, Config(curriculum=curriculum))
    agent = init_agent(Config(), jax.random.key(1), task.obs_dim, task.action_dim)
    state = method.init(jax.random.key(0))
    starts = jax.jit(method.propose)(jax.random.key(1), state, agent)[1]
    assert starts.capacity == NEW + OLD
    assert np.all(starts.valid)
    assert np.all(np.abs(starts.qpos[:, 0]) <= 0.3)
    # Twice as many are looked at as are needed, so that hardly one has to be taken twice.
    assert len(positions(starts.take(jnp.arange(NEW)))) > 0.7 * NEW
    _, metrics = jax.jit(method.update)(jax.random.key(2), state, starts, outcomes([GOOD] * (NEW + OLD)))
    walks = CONFIG.brownian_horizon * 10  # 100 candidates, 10 of each
    assert metrics.proposal_steps == walks + 5 * 2 * NEW


def test_where_nothing_settles_training_begins_at_the_goal() -> None:
    """Without a replay, too."""
    task = Ridge(gain=0.1, feasible_radius=2.0)
    task.stays_within = -1.0
    method = Compiled(Reverse(task, Config(curriculum=dataclasses.replace(CONFIG, num_old=0))))
    starts = method.propose(jax.random.key(1), method.init(jax.random.key(0)))
    assert np.all(starts.valid)
    assert positions(starts) == {0.0}


# ----------------------------------------------------------------------------------------------------- all_starts


@pytest.mark.slow
def test_all_starts_selects_everything() -> None:
    """The ablation: select is the identity, whatever the labels; all are remembered; T_B adapts all the same."""
    method = Compiled(make_method("all_starts", TASK, Config(curriculum=CONFIG)))
    for kind in (HARD, GOOD, MASTERED, UNKNOWN):
        state = method.init(jax.random.key(0))
        starts = method.propose(jax.random.key(1), state)
        after, metrics = method.update(jax.random.key(2), state, starts, outcomes([kind] * (NEW + OLD)))
        jax.tree.map(np.testing.assert_array_equal, after.seeds, starts)
        assert int(after.replay.count()) == 1 + NEW + OLD
        assert positions(after.replay) == {0.0} | positions(starts)
        grown = 1.3 if kind is MASTERED else 1.0
        np.testing.assert_allclose(after.walk_length, grown * CONFIG.brownian_horizon, rtol=1e-6)
        assert metrics.brownian_horizon == CONFIG.brownian_horizon


# -------------------------------------------------------------------------------------------------------- uniform


def test_uniform_draws_feasible_starts_uniformly() -> None:
    method = Compiled(make_method("uniform", TASK, Config(curriculum=CONFIG)))
    feasible = positions(TASK.feasible_starts())
    state = method.init(jax.random.key(0))
    counts = dict.fromkeys(sorted(feasible), 0)
    for i in range(200):
        starts = method.propose(jax.random.key(i), state)
        assert starts.capacity == NEW + OLD
        assert np.all(starts.valid)
        assert len(positions(starts)) == NEW + OLD  # without replacement
        assert positions(starts) <= feasible
        for x in positions(starts):
            counts[x] += 1
    # Without replacement counts vary less than independent ones.
    assert stats.chisquare(list(counts.values())).pvalue > 1e-3


def test_uniform_reports_and_remembers_nothing() -> None:
    method = Compiled(make_method("uniform", TASK, Config(curriculum=CONFIG)))
    starts = method.propose(jax.random.key(0), None)
    kinds = [GOOD] * 3 + [HARD] * 5 + [MASTERED] * 1 + [UNKNOWN] * 9
    state, metrics = method.update(jax.random.key(1), None, starts, outcomes(kinds))
    assert state is None
    np.testing.assert_allclose([metrics.share_low, metrics.share_good, metrics.share_high], [5 / 9, 3 / 9, 1 / 9])
    np.testing.assert_allclose(metrics.labelled, 0.5)
    assert metrics.proposal_steps == metrics.brownian_horizon == metrics.replay_size == 0


# ------------------------------------------------------------------------------------------------------- registry


def test_every_named_method_keeps_the_contract() -> None:
    """Same shapes in and out, so that one train step serves all; all report what MethodMetrics says."""
    assert set(METHODS) == set(METHOD_NAMES)
    task = ExactLine(feasible_radius=2.0)
    config = with_sizes(Config(curriculum=CONFIG), task.horizon)
    agent = init_agent(config, jax.random.key(0), task.obs_dim, task.action_dim)
    for name in METHODS:
        method = make_method(name, task, config)
        state = method.init(jax.random.key(0))
        proposing, starts = jax.eval_shape(method.propose, jax.random.key(0), state, agent)
        assert starts.capacity == NEW + OLD
        new_labels = outcomes([GOOD] * (NEW + OLD))
        after, metrics = jax.eval_shape(method.update, jax.random.key(0), state, starts, new_labels)
        for other in (proposing, after):
            assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(
                lambda x: (x.shape, x.dtype), other
            )
        assert isinstance(metrics, MethodMetrics)
        assert all(x.shape == () for x in jax.tree.leaves(metrics))
