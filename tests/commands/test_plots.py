"""Pictures of a run."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rcg_jax.io.tables import read_columns
from rcg_jax.report.plots import learning_curve, starts_picture, write_run_pictures
from rcg_jax.runs.load import LoadedRun, load_run
from rcg_jax.runs.recorder import Evaluation
from tests import tiny_run

METRICS = """iteration,env_steps,success,start_distance,share_low,share_good,share_high
1,2000,0.25,0.1,0.5,0.5,0
2,4000,0.5,0.2,0.25,0.25,0.5
3,6000,0.75,0.3,0,0.25,0.75
"""


@pytest.fixture(scope="module")
def saved(tiny: Path) -> Path:
    run = tiny_run.save_run(tiny / "runs")
    (run / "metrics.csv").write_text(METRICS)
    rows = [Evaluation(k, 2000 * k, 20 * k, 25 * k, 100, "abc").row() for k in (1, 3)]
    lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
    (run / "eval.csv").write_text("\n".join(lines) + "\n")
    return run


@pytest.fixture(scope="module")
def loaded(saved: Path) -> LoadedRun:
    return load_run(saved)


def test_what_has_no_data_is_left_out(run: Path) -> None:
    assert write_run_pictures(run) == [run / "learning_curve.png", run / "starts.png"]
    (run / "eval.csv").unlink()
    shutil.rmtree(run / "checkpoints")
    assert write_run_pictures(run) == [run / "learning_curve.png"]
    (run / "metrics.csv").write_text(METRICS.splitlines()[0] + "\n")
    assert write_run_pictures(run) == []


def test_the_learning_curve_shows_the_numbers(saved: Path) -> None:
    metrics, evaluations = read_columns(saved / "metrics.csv"), read_columns(saved / "eval.csv")
    figure = learning_curve(metrics, evaluations, "tiny")
    success, shares, distance = figure.axes
    lines = {str(line.get_label()): line for line in success.get_lines()}
    np.testing.assert_allclose(lines[r"on $\rho_0$, stochastic policy"].get_xydata(), [[0.002, 0.2], [0.006, 0.6]])
    np.testing.assert_allclose(lines[r"on $\rho_0$, mean policy"].get_ydata(), [0.25, 0.75])
    np.testing.assert_allclose(lines[r"on $\rho_i$ (training starts)"].get_ydata(), metrics["success"])
    np.testing.assert_allclose(distance.get_lines()[0].get_ydata(), metrics["start_distance"])
    assert [text.get_text() for text in shares.get_legend().get_texts()] == ["mastered", "good", "too hard"]
    assert distance.get_xlabel() == "environment steps [million]"
    assert distance.get_ylabel().endswith("[m]")


def test_the_histogram_counts_every_start_once(loaded: LoadedRun) -> None:
    figure = starts_picture(loaded, "tiny")
    histogram, plan = figure.axes
    labels = {text.get_text() for text in histogram.get_legend().get_texts()}
    assert {"mastered (10)", "good (10)", "too hard (5)", "too few episodes (5)"} <= labels
    bars = [bar for container in histogram.containers for bar in container]
    assert sum(getattr(bar, "get_height", lambda: 0)() for bar in bars) == 30
    # One cloud per kind, and the goal.
    assert sum(len(np.asarray(cloud.get_offsets())) for cloud in plan.collections) == 30 + 1


def test_without_feasible_starts_there_is_no_reference(
    loaded: LoadedRun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tiny_run.Tiny, "feasible_file", tmp_path / "none.npz")
    histogram, plan = starts_picture(loaded, "tiny").axes
    assert not [text for text in histogram.get_legend().get_texts() if "rho_0" in text.get_text()]
    title = plan.get_title() or plan.get_title(loc="left")  # where a figure's style was used before in this process
    assert title == "the model's “centre”, seen from above"
