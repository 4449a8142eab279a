"""Whole runs from the command line: several seeds at once, other methods."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rcg_jax.io.tables import read_csv
from tests.real_run import metrics, state_digest, train


@pytest.mark.slow
def test_seeds_together_equal_each_alone_and_go_on_alone(tmp_path: Path) -> None:
    # One policy update: after more, rounding has grown into other trajectories.
    settings = ["task=point_maze", "engine=native", "iterations=1", "trpo.iterations=1"]
    settings += ["rollout.batch_size=10000", "curriculum.replay_capacity=400"]
    train(tmp_path / "both", *settings, "num_seeds=2", "seed=5")
    train(tmp_path / "alone", *settings, "seed=6")
    both, alone = (tmp_path / name / "point_maze" / "reverse" for name in ("both", "alone"))
    names = {path.name for path in (alone / "seed6").iterdir()}
    assert {"config.yaml", "metrics.csv", "eval.csv", "tensorboard", "checkpoints"} <= names
    assert {path.name for path in (both / "seed6").iterdir()} == names
    one, other = (read_csv(folder / "seed6" / "metrics.csv") for folder in (alone, both))
    assert one[0] == other[0]
    values = [[float(cell) for cell in rows[0][:-2]] for rows in (one[1], other[1])]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-2, atol=1e-4)
    # Different seeds are different runs.
    assert metrics(both / "seed5") != metrics(both / "seed6")
    train(tmp_path / "both", *settings, "iterations=2", "seed=6")
    assert [row[0] for row in metrics(both / "seed6")] == ["1", "2"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["oracle", "self_play"])
def test_other_methods_resume_bit_for_bit(tmp_path: Path, method: str) -> None:
    settings = ["task=point_maze", f"method={method}", "engine=native", "oracle.num_points=20", "oracle.max_rounds=2"]
    settings += ["trpo.iterations=1", "rollout.num_envs=4"]
    train(tmp_path / "whole", *settings, "iterations=2")
    train(tmp_path / "parts", *settings, "iterations=1")
    train(tmp_path / "parts", *settings, "iterations=2")
    whole, parts = (tmp_path / name / "point_maze" / method / "seed0" for name in ("whole", "parts"))
    assert len(metrics(whole)) == 2
    assert metrics(parts) == metrics(whole)
    assert state_digest(parts) == state_digest(whole)
