"""From run folders to CSV files to figures: the numbers on the way, and what a figure says about missing runs."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.common import RESULTS, read
from experiments.paper import (
    collect,
    curves,
    figures,
    good_starts,
    pages,
    results_table,
)
from rcg_jax.config.settings import Config, flatten
from rcg_jax.io.tables import CsvLog
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.recorder import EVAL_COLUMNS
from rcg_jax.tasks import TASKS, task_class
from rcg_jax.tasks.training import training_config

COLUMNS = ["iteration", "env_steps", "success", "share_low", "share_good", "share_high", "labelled", "proposal_steps"]


def trained_with(*words: str) -> Config:
    """The resolved settings of a run with these words."""
    config = training_config(["task=ring_peg", *words])
    return with_sizes(config, task_class(config.task).horizon)


def write_run(root: Path, seed: int, success: dict[int, float], iterations: int, *words: str) -> RunFolder:
    """A run of 10 steps an iteration, whose share of good starts is its iteration / 100."""
    config = trained_with("engine=native", f"iterations={iterations}", f"run_dir={root}", *words)
    folder = RunFolder(config, seed)
    folder.path.mkdir(parents=True)
    folder.write_config()
    log = CsvLog(folder.metrics_file, [*COLUMNS, "wall_s"], keep=0)
    for i in range(1, iterations + 1):
        share = {"share_low": 0.0, "share_good": i / 100, "share_high": 1 - i / 100}
        cells = {"iteration": i, "env_steps": 10 * i, "success": 0.5, "labelled": float(i != 2), "wall_s": 2.0 * i}
        log.append({**cells, **share, "proposal_steps": 7})
    evals = CsvLog(folder.eval_file, EVAL_COLUMNS, keep=0)
    for i, rate in success.items():
        row = {**dict.fromkeys(EVAL_COLUMNS, 0.0), "iteration": i, "env_steps": 10 * i, "starts_sha256": "abc"}
        evals.append({**row, "success_stochastic": 0.0, "episodes": 500})
        # Evaluated once more, with more episodes: these count.
        evals.append({**row, "success_stochastic": rate, "episodes": 2000})
    return folder


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Reverse: three seeds, one of them unfinished; all_starts: one; with the distance penalty: two."""
    runs = tmp_path / "runs"
    write_run(runs, 0, {2: 0.2, 4: 0.8}, 4)
    write_run(runs, 1, {2: 0.4, 4: 1.0}, 4)
    write_run(runs, 2, {2: 0.9}, 2)
    write_run(runs, 0, {4: 0.5}, 4, "method=all_starts")
    for seed in (0, 1):
        write_run(runs / "d", seed, {4: 0.1}, 4, "reward=distance")
    assert collect.collect(runs, tmp_path, default_commit="1234abc") == 6
    return tmp_path


def test_rows_of_a_run(tmp_path: Path) -> None:
    run = write_run(tmp_path, 0, {2: 0.25, 3: 0.75}, 4)
    rows = collect.curve_rows(run.path, {"seed": 0})
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["success_stochastic"] for row in rows] == ["", 0.25, 0.75, ""]
    assert [row["eval_episodes"] for row in rows] == ["", 2000, 2000, ""]
    # Where nothing was labelled there is no share, not a share of zero.
    assert [row["share_good"] for row in rows] == [0.01, "", 0.03, 0.04]
    assert [row["proposal_steps"] for row in rows] == [7, 14, 21, 28]


def test_a_run_is_known_by_its_settings_and_a_shorter_one_does_not_replace_it(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = {collect.key_of(row): row for row in read(results / "runs.csv")}
    today = collect.present("default", "ring_peg")
    first = rows["reverse", "sparse", "default", "0", "", today]
    assert first["command"] == "python -m rcg_jax.run task=ring_peg method=reverse engine=native seed=0 iterations=4"
    assert (first["commit"], first["seconds"], first["success_stochastic"]) == ("1234abc", "8.0", "0.8")
    more = results / "more"
    write_run(more / "a", 0, {3: 0.0}, 3)
    write_run(more / "b", 1, {4: 0.3}, 4)
    write_run(more / "c", 0, {4: 0.3}, 4, "trpo.max_kl=0.02")
    collect.collect(more, results)
    assert "curves_ring_peg.csv has 40 steps of it, this run 30; kept" in capsys.readouterr().out
    rows = {collect.key_of(row): row for row in read(results / "runs.csv")}
    assert rows["reverse", "sparse", "default", "0", "", today]["success_stochastic"] == "0.8"
    assert rows["reverse", "sparse", "default", "1", "", today]["success_stochastic"] == "0.3"
    (other,) = [row for key, row in rows.items() if key[4] == "trpo.max_kl=0.02"]
    assert other["command"].endswith("trpo.max_kl=0.02")
    assert other["config"] != today
    # Figures show the run with the default settings.
    reverse = curves.find(curves.load("ring_peg", results), "reverse")
    assert reverse is not None
    assert reverse.settings == ""


def digest(*words: str) -> str:
    return collect.digest({name: value for name, _, value in flatten(trained_with(*words))})


def test_the_digest_is_of_what_is_learned() -> None:
    here = digest("seed=3", "iterations=7", "run_dir=x", "engine=mjx", "eval_every=3")
    assert digest() == here == collect.present("default", "ring_peg")
    assert digest("devices=all", "matmul_precision=default") == here, "rounding is not what is learned"
    assert digest("trpo.max_kl=0.02") != here
    assert digest("curriculum.rho_0_share=0.5") == collect.present("default", "ring_peg", guided=True) != here
    assert digest("preset=paper") == collect.present("paper", "ring_peg") != here


@pytest.mark.parametrize("task", TASKS)
def test_a_run_of_today_differs_in_nothing(task: str, tmp_path: Path) -> None:
    for preset in ("default", "paper"):
        write_run(tmp_path / preset, 0, {1: 0.5}, 1, f"task={task}", f"preset={preset}")
    found = {key[2]: key[4:] for key in collect.find(tmp_path)[task]}
    assert found == {preset: ("", collect.present(preset, task)) for preset in ("default", "paper")}


def test_two_collections_at_once_lose_no_rows(tmp_path: Path) -> None:
    for seed in range(4):
        write_run(tmp_path / str(seed), seed, {2: 0.5}, 2)
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda seed: collect.collect(tmp_path / str(seed), tmp_path / "out"), range(4)))
    assert len(read(tmp_path / "out" / "runs.csv")) == 4
    assert not list((tmp_path / "out").glob("*.tmp"))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda text: text[: len(text) - 40], "curves_ring_peg.csv: line "),
        (lambda text: "a,b\n1,2\n", "curves_ring_peg.csv: lacks the columns method, reward"),
        (lambda text: text.replace(",40,", ",forty,", 1), "could not convert string to float: 'forty'"),
    ],
)
def test_a_damaged_csv_file_is_one_line(
    damage: Any, says: str, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results / "curves_ring_peg.csv"
    path.write_text(damage(path.read_text()))
    monkeypatch.setattr("sys.argv", ["good_starts", f"results={results}"])
    capsys.readouterr()
    assert good_starts.main() == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1


def test_bands_are_of_the_seeds_that_got_furthest(results: Path) -> None:
    reverse = curves.find(curves.load("ring_peg", results), "reverse")
    assert reverse is not None
    band = reverse.band("success_stochastic")
    np.testing.assert_allclose(band.steps, [20, 40])
    np.testing.assert_allclose(band.mean, [0.3, 0.9])
    np.testing.assert_allclose(band.std, [0.1 * math.sqrt(2)] * 2)
    assert len(band.shorter) == 1
    assert reverse.missing == [3, 4]


def test_intervals_of_a_mean() -> None:
    # Student's t of 4 degrees of freedom: 2.776.
    low, high = curves.interval(np.array([0.4, 0.45, 0.5, 0.55, 0.6]))
    assert (low, high) == pytest.approx((0.5 - 0.0982, 0.5 + 0.0982), abs=1e-4)
    assert curves.interval(np.array([0.0, 1.0])) == (0.0, 1.0)
    assert np.isnan(curves.interval(np.array([0.3]))).all()


def test_the_table(results: Path) -> None:
    every = results_table.write(results)
    rows = {(row["method"], row["reward"], row["preset"]): row for row in every if row["task"] == "ring_peg"}
    (first, *_) = read(results / "results.csv")
    assert tuple(first)[: len(results_table.COLUMNS)] == results_table.COLUMNS
    reverse = rows["reverse", "sparse", "default"]
    assert (reverse["success_mean"], reverse["success_low"], reverse["success_high"]) == (pytest.approx(0.9), 0.8, 1.0)
    assert (reverse["seeds"], reverse["unfinished"], reverse["env_steps"]) == (2, 1, 40)
    assert (reverse["mean_over_run"], reverse["proposal_steps"], reverse["seconds"]) == (0.6, 28, 8.0)
    assert (reverse["starts_hash"], reverse["commit"]) == ("abc", "1234abc")
    # Seed 0 is evaluated at 20 and 40 steps with 0.2 and 0.8, seed 1 with 0.4 and 1.0.
    assert [(reverse[f"steps_to_{x}"], reverse[f"reached_{x}"]) for x in (0.25, 0.45, 0.9)] == [
        (30, 2),
        (40, 2),
        ("", 1),
    ]
    assert reverse["command"].startswith(
        "python -m rcg_jax.run -m task=ring_peg method=reverse engine=native seed=0,1 "
    )
    assert rows["reverse", "distance", "default"]["success_mean"] == pytest.approx(0.1)
    theirs = rows["reverse", "sparse", "published"]
    assert (theirs["success_mean"], theirs["success_high"], theirs["env_steps"]) == (0.45, "0.645", "")
    text = results_table.markdown(read(results / "results.csv"))
    assert (
        "| ring_peg | reverse | no | 0.45 (0.26 to 0.645) | 0.900 (0.800 to 1.000) | 0.000 | 0.0 | 0.0 | 1 of 2 |"
        in text
    )
    assert "| ring_peg | uniform | | 0.12 (0.08 to 0.15) | not run |" in text
    assert "| ring_peg | reverse reward=distance | no |  |" in text


def test_all_figures_are_drawn_from_what_there_is(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["figures", "only=table,fig2,fig3,fig5", f"results={results}"])
    assert figures.main() == 0
    out = capsys.readouterr().out
    for name in ("fig2_learning_curves", "fig3_good_starts", "fig5_distance_reward"):
        assert (results / f"{name}.png").exists()
    assert "fig5: key_insertion lacks " in out
    for word, says in (("only=fig9", "only=fig9: fig9 is none of"), (f"results={results / 'none'}", "no such folder")):
        monkeypatch.setattr("sys.argv", ["figures", word])
        assert figures.main() == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert says in line
    assert not (results / "none").exists()


def test_the_committed_pages_and_tables_are_those_of_the_committed_runs() -> None:
    rows = [{name: str(cell) for name, cell in row.items()} for row in results_table.tabulate(RESULTS)]
    assert rows == [dict(row) for row in read(RESULTS / "results.csv")]
    for name in pages.PAGES:
        text = (pages.ROOT / name).read_text()
        assert pages.renewed(text, RESULTS) == text, f"python -m experiments.paper.pages renews {name}"
