"""Success by region: every episode is counted where it belongs."""

from __future__ import annotations

import numpy as np
import pytest

from rcg_jax.evaluate.regions import COLUMNS, make_regions, region_rows
from rcg_jax.evaluate.stats import wilson_interval

DISTANCE = np.array([0.05, 0.1, 0.15, 0.31, 0.31, 0.05])
STOCHASTIC = np.array([True, True, False, False, True, True])
MEAN = np.array([True, False, False, False, False, True])
INSIDE = np.array([True, True, True, False, False, True])
AT_GOAL = np.array([True, False, False, False, False, False])

ABOUT = {"task": "key", "seed": 1, "method": "reverse", "env_steps": 9, "engine": "native", "evaluation_seed": 0}


def counts(subsets: dict[str, np.ndarray]) -> dict[tuple[str, str], tuple[int, int, int]]:
    regions = make_regions(DISTANCE, subsets, STOCHASTIC, MEAN)
    return {(r.kind, r.name): (r.episodes, r.successes_stochastic, r.successes_mean) for r in regions}


def test_known_counts() -> None:
    assert counts({"at_goal": AT_GOAL, "inside": INSIDE, "nowhere": np.zeros(6, bool)}) == {
        ("all", "all"): (6, 4, 2),
        ("distance", "0.0-0.1"): (2, 2, 2),
        ("distance", "0.1-0.2"): (2, 1, 0),
        ("distance", "0.3-0.4"): (2, 1, 0),
        ("composition", "at_goal"): (1, 1, 1),
        ("composition", "not at_goal"): (5, 3, 1),
        ("composition", "inside"): (4, 3, 2),
        ("composition", "not inside"): (2, 1, 0),
        ("composition", "not nowhere"): (6, 4, 2),
    }


def test_parts_that_divide_the_starts_have_no_complements() -> None:
    found = counts({"at_goal": AT_GOAL, "cell_0": INSIDE, "cell_1": ~INSIDE})
    names = [name for kind, name in found if kind == "composition"]
    assert names == ["at_goal", "not at_goal", "cell_0", "cell_1"]


def test_rows() -> None:
    rows = region_rows(make_regions(DISTANCE, {"inside": INSIDE}, STOCHASTIC, MEAN), starts_sha256="ab", **ABOUT)
    assert all(tuple(row) == COLUMNS for row in rows)
    row = rows[-2]
    assert (row["region_kind"], row["region"], row["policy"]) == ("composition", "not inside", "stochastic")
    assert (row["successes"], row["episodes"]) == (1, 2)
    assert (row["low"], row["high"]) == pytest.approx(wilson_interval(1, 2))
    assert rows[-1]["policy"] == "mean"
    assert rows[-1]["successes"] == 0
