"""A short run with ``preset=paper``, so that nothing alters the paper's algorithm unnoticed.

Sizes are scaled down, every other value is the preset's. What is compared are means over seeds, with room for what
rounding on another processor leads to; what changes when one of the preset's values is taken back is many times that.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

from rcg_jax.config.compose import compose_config
from rcg_jax.config.settings import Config
from rcg_jax.physics.jit import jit
from rcg_jax.train_step import init_train_state, make_train_step
from tests.analytic import ExactLine

SIZES = (
    "preset=paper",
    "curriculum.num_new=20",
    "curriculum.num_old=10",
    "curriculum.num_candidates=500",
    "curriculum.brownian_horizon=10",
    "curriculum.brownian_horizon_max=10",
    "curriculum.replay_capacity=500",
    "rollout.num_envs=10",
    "rollout.batch_size=1000",
    "policy.hidden=[16]",
    "baseline.hidden=[16]",
    "baseline.minibatch_size=100",
)

SEEDS, ITERATIONS = 32, 6

#: Share of successes, mean distance of the starts, share of good starts, RMS error of V: means over the seeds, one row
#: for each iteration.
GOLDEN = np.array(
    [
        [0.8800, 0.7912, 0.8948, 0.9132, 0.8982, 0.8630],
        [0.0413, 0.1003, 0.1285, 0.1683, 0.2297, 0.2735],
        [0.3667, 0.5156, 0.4000, 0.2719, 0.2594, 0.2708],
        [0.5069, 0.4180, 0.3636, 0.3170, 0.3212, 0.3439],
    ]
).T
GOLDEN_UNIFORM = np.array(
    [
        [0.1271, 0.1703, 0.2348, 0.2581, 0.3238, 0.3291],
        [0.5094, 0.4979, 0.4977, 0.5045, 0.4894, 0.5066],
        [0.1391, 0.1396, 0.1461, 0.1273, 0.1504, 0.1211],
        [0.1611, 0.2207, 0.2783, 0.2811, 0.3017, 0.2810],
    ]
).T

#: What rounding may change: nothing in the first iterations, a little later on.
ROOM = np.array([[0.01], [0.015], [0.02], [0.02], [0.03], [0.03]])


#: Success and physics steps of the walks where all is mastered soon, and walks out of the stall follow.
GOLDEN_STALL = np.array(
    [[0.7770, 0.9545, 0.9874, 0.9950, 0.9987, 0.9996], [500.0, 500.0, 575.0, 800.0, 875.0, 1150.0]]
).T


def line(gain: Any) -> ExactLine:
    return ExactLine(horizon=40, gain=gain, order=1)


@cache
def compiled(method: str, *changes: str) -> tuple[Config, Any]:
    """Settings, and a train step of all seeds and of a line with any gain."""
    config = compose_config([*SIZES, f"method={method}", *changes])
    return config, jit(lambda gain, state: jax.vmap(make_train_step(config, line(gain)))(state))


def curve(method: str, *changes: str, gain: float = 0.02) -> np.ndarray:
    config, step = compiled(method, *changes)
    state = jax.vmap(lambda seed: init_train_state(config, line(gain), seed))(np.arange(SEEDS))
    rows = []
    for _ in range(ITERATIONS):
        state, m = step(gain, state)
        columns = (m.success, m.start_distance, m.starts.share_good, m.value_error, m.starts.proposal_steps)
        rows.append([float(np.mean(column)) for column in columns])
    return np.array(rows)


@pytest.mark.parametrize(
    ("method", "golden"), [("reverse", GOLDEN), pytest.param("uniform", GOLDEN_UNIFORM, marks=pytest.mark.slow)]
)
def test_the_papers_algorithm_is_what_it_was(method: str, golden: np.ndarray) -> None:
    assert np.all(np.abs(curve(method)[:, :4] - golden) < ROOM), curve(method).T.round(4)


def test_walks_out_of_a_stall_are_what_they_were() -> None:
    """In a share of the seeds no start is good and most are mastered: there two walks of 10 T = 400 steps follow."""
    found = curve("reverse", gain=0.2)[:, [0, 4]]
    assert np.all(np.abs(found - GOLDEN_STALL) < np.array([0.02, 130.0])), found.T.round(4)


@pytest.mark.slow
@pytest.mark.parametrize("changes", ["rollout.batch=segments", "curriculum.walk_rounds=50", "trpo.gae_lambda=0.9"])
def test_the_golden_numbers_tell_each_of_these_apart(changes: str) -> None:
    assert np.any(np.abs(curve("reverse", changes)[:, :4] - GOLDEN) > 1.5 * ROOM)
