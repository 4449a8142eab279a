"""``python -m rcg_jax.evaluate``: its numbers, its CSV file, its refusals."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from rcg_jax import export
from rcg_jax.evaluate.__main__ import main
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.io.starts_file import starts_hash
from rcg_jax.physics.jit import jit
from rcg_jax.report.outcomes import robustness
from rcg_jax.runs.load import load_run
from tests import tiny_run


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "evaluation.csv").open() as file:
        return list(csv.DictReader(file))


def error_line(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line with which the command refuses."""
    assert main(argv) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def test_numbers_agree_with_make_evaluate(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"run={run}", "episodes=80", "seed=5"]) == 0
    (row,) = rows(run)
    loaded = load_run(run)
    result = jax.device_get(jit(make_evaluate(loaded.pi, loaded.task, 80))(loaded.actor, jax.random.key(5)))

    assert 0 < int(result.successes_stochastic) < 80
    for name, successes, episodes in (
        ("stochastic", result.successes_stochastic, result.stochastic),
        ("mean", result.successes_mean, result.mean),
    ):
        low, high = wilson_interval(int(successes), 80)
        assert float(row[f"success_{name}"]) == pytest.approx(successes / 80)
        assert float(row[f"success_{name}_low"]) == pytest.approx(low)
        assert float(row[f"success_{name}_high"]) == pytest.approx(high)
        assert float(row[f"steps_to_goal_{name}"]) == pytest.approx(episodes.length[episodes.success].mean())
    assert row["starts_sha256"] == starts_hash(loaded.task.feasible_file)
    assert (row["engine"], row["episodes"], row["seed"], row["iteration"]) == ("native", "80", "5", "3")
    assert int(row["env_steps"]) == 3 * 2 * 1000
    assert row["jax"] == jax.__version__
    assert row["command"] == f"python -m rcg_jax.evaluate run={run} episodes=80 seed=5"
    assert f"{float(row['success_stochastic']):.3f}" in capsys.readouterr().out


def test_distance_bins_hold_every_episode(run: Path) -> None:
    main([f"run={run}", "episodes=80"])
    (row,) = rows(run)
    bins = np.array([[float(x) for x in cell.split(":")] for cell in row["success_by_distance"].split()])
    _, episodes, stochastic, mean = bins.T
    assert np.all(np.diff(bins[:, 0]) > 0)
    assert episodes.sum() == 80
    assert stochastic.sum() / 80 == pytest.approx(float(row["success_stochastic"]))
    assert mean.sum() / 80 == pytest.approx(float(row["success_mean"]))


@pytest.mark.slow
def test_rows_are_appended_and_the_same_command_repeats_its_numbers(run: Path) -> None:
    for iteration in ("2", "newest", "newest"):
        assert main([f"run={run}", "episodes=10", f"iteration={iteration}"]) == 0
    found = rows(run)
    assert [row["iteration"] for row in found] == ["2", "3", "3"]
    assert found[1] == found[2]


@pytest.mark.slow
def test_a_policy_file_gives_the_numbers_of_its_run(run: Path, tmp_path: Path) -> None:
    assert export.main([f"run={run}", "episodes=30", f"out={tmp_path / 'one.npz'}"]) == 0
    tables = []
    for subject in (f"run={run}", f"policy={tmp_path / 'one.npz'}"):
        out = tmp_path / f"{len(tables)}.csv"
        assert main([subject, "episodes=80", "seed=5", f"out={out}"]) == 0
        with out.open() as file:
            tables.append(list(csv.DictReader(file)))
    assert tables[0] == tables[1]
    assert len(rows(run)) == 1
    whole, distance = tables[0][0], [row for row in tables[0] if row["region_kind"] == "distance"]
    assert [whole[name] for name in ("task", "seed", "policy", "region", "method")] == [
        "tiny", "0", "stochastic", "all", "reverse",
    ]  # fmt: skip
    assert int(whole["successes"]) / 80 == pytest.approx(float(rows(run)[0]["success_stochastic"]))
    for policy in ("stochastic", "mean"):
        assert sum(int(row["episodes"]) for row in distance if row["policy"] == policy) == 80
    parts = {row["region"]: row for row in tables[0] if row["region_kind"] == "composition"}
    # No start of the tiny task lies at its goal.
    assert list(parts) == ["not at_goal"]
    # Another evaluation is added; a file with other columns is left alone.
    assert main([f"run={run}", "episodes=5", f"out={tmp_path / '0.csv'}"]) == 0
    assert len((tmp_path / "0.csv").read_text().splitlines()) > len(tables[0]) + 2


def test_a_changed_world_is_in_a_table_of_its_own_and_in_the_report(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"run={run}", "episodes=40", "perturb=latency"]) == 0
    assert main([f"run={run}", "episodes=30", "perturb=motor,latency"]) == 0
    shown = capsys.readouterr().out
    with (run / "robustness.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["perturbed"] for row in table] == ["none", *["latency"] * 3, "none", *["motor"] * 4, *["latency"] * 3]
    assert all(row["perturbed"] in shown for row in table)
    sections = robustness(run)  # of the newest evaluation alone
    assert sections[0]["title"] == "the task as it is"
    assert [len(one["rows"]) for one in sections] == [1, 4, 3]
    assert sections[2]["rows"][1]["label"] == "2 (40 ms)"
    for one, row in zip((r for each in sections for r in each["rows"]), table[4:], strict=True):
        assert (one["episodes"], one["rate"]) == (30, pytest.approx(float(row["success_stochastic"])))


def test_a_policy_that_never_succeeds_has_no_steps_to_goal(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Only the goal state itself, which no episode hits.
    monkeypatch.setattr(tiny_run.Tiny, "is_goal", lambda self, s: self.distance(s) < 1e-6)
    main([f"run={run}", "episodes=10"])
    (row,) = rows(run)
    assert (row["success_mean"], row["steps_to_goal_mean"]) == ("0", "")


def test_a_damaged_newest_checkpoint_falls_back_and_says_so(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (run / "checkpoints" / "3").rglob("*"):
        if path.is_file() and path.stat().st_size:
            path.write_bytes(path.read_bytes()[:-1])
    assert main([f"run={run}", "episodes=10"]) == 0
    assert "checkpoints/3 is damaged" in capsys.readouterr().err
    assert rows(run)[0]["iteration"] == "2"
    assert "damaged" in error_line(capsys, f"run={run}", "iteration=3")


def test_refuses_a_run_without_checkpoints_and_a_task_without_starts(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(tiny_run.Tiny, "feasible_file", run / "none.npz")
        assert "none.npz" in error_line(capsys, f"run={run}")
    shutil.rmtree(run / "checkpoints")
    assert "no checkpoint yet" in error_line(capsys, f"run={run}")


def test_refuses_a_csv_file_with_other_columns(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "evaluation.csv").write_text("a,b\n1,2\n")
    assert "other columns" in error_line(capsys, f"run={run}", "episodes=5")
    assert (run / "evaluation.csv").read_text() == "a,b\n1,2\n"
