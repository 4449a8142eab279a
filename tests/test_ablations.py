"""The table of ablations, from runs that were collected."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from experiments import ablations
from experiments.common import RESULTS, read
from experiments.paper.collect import present

COLUMNS = (
    "task",
    "seed",
    "ended",
    "config",
    "iterations",
    "planned",
    "env_steps",
    "success_stochastic",
    "success_mean",
    "commit",
)


def write(results: Path, rows: list[tuple[object, ...]]) -> None:
    (results / "ablations").mkdir()
    with open(results / "ablations" / "runs.csv", "w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])


def test_the_defaults_are_those_of_all_runs() -> None:
    digests = {change.name: ablations._digest(change, "ring_peg") for change in ablations.CHANGES}
    same = {digests.pop(name) for name in ("towards_rho_0", "small_steps", "long_credit", "small_v")}
    assert same == {digests["none"]} == {present("default", "ring_peg", guided=True)}
    assert len(set(digests.values())) == len(digests)  # each other change changes something


@pytest.mark.parametrize("change", ablations.CHANGES, ids=lambda change: change.name)
def test_all_have_the_same_number_of_steps(change: ablations.Change) -> None:
    batch = 50_000 if "rollout.batch_size=50000" in change.settings else 20_000
    assert ablations._iterations("ring_peg", change) * 5 * batch == 1e6 * ablations.LENGTHS["ring_peg"]


def test_every_change_changes_something_or_is_left_out() -> None:
    for task in ablations.TASKS:
        changes = [change for change in ablations.CHANGES if ablations.is_change(change, task)]
        assert changes[0] is ablations.CHANGES[0]
        assert len({ablations._digest(change, task) for change in changes}) == len(changes)
        held = task in ("ring_peg", "key_insertion")
        names = [change.name for change in changes]
        assert ("every_step" in names) == held
        biased = task in ("ring_peg", "ant_maze")
        assert ({"small_steps", "long_credit", "small_v"} <= {*names}) == (task == "ant_maze")
        assert ("no_bias" in names, "towards_rho_0" in names) == (biased, not biased)


@pytest.mark.parametrize("word", ["change=foo", "task=foo"])
def test_unknown_names_are_refused_in_one_line(
    word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["ablations", word])
    assert ablations.main() == 2
    assert capsys.readouterr().err.startswith(f"error: {word}: foo is unknown; all, or some of ")


def test_rows_of_the_present_defaults_only(tmp_path: Path) -> None:
    here, fixed = (ablations._digest(change, "ring_peg") for change in (ablations.CHANGES[0], ablations.CHANGES[3]))
    maze = ablations._digest(ablations.CHANGES[3], "point_maze")
    write(
        tmp_path,
        [
            ("ring_peg", 1, "2026-02", here, 50, 50, 5_000_000, 0.7, 0.8, "abc"),
            # The same seeds, as a change that the defaults became: the later ones count, whichever stand first.
            ("ring_peg", 1, "2026-01", here, 50, 50, 5_000_000, 0.2, 0.3, "old"),
            ("ring_peg", 0, "2026-01", here, 50, 50, 5_000_000, 0.2, 0.3, "old"),
            ("ring_peg", 0, "2026-02", here, 50, 50, 5_000_000, 0.9, 0.8, "abc"),
            ("ring_peg", 0, "2026-02", fixed, 50, 50, 5_000_000, 0.5, 0.6, "abc"),
            ("ring_peg", 1, "2026-02", fixed, 20, 50, 2_000_000, 0.1, 0.1, "abc"),  # unfinished
            ("ring_peg", 0, "2026-03", here, 20, 20, 2_000_000, 0.1, 0.1, "abc"),  # of another length, as planned
            ("ring_peg", 2, "2026-03", here, 100, 100, 10_000_000, 0.1, 0.1, "abc"),
            ("ring_peg", 0, "2026-02", "01234567", 50, 50, 5_000_000, 0.0, 0.0, "old"),
            ("point_maze", 0, "2026-02", maze, 50, 50, 5_000_000, 0.25, 0.5, "abc"),
        ],
    )
    rows = ablations.tabulate(tmp_path)
    assert [(row["task"], row["change"], row["seeds"]) for row in rows] == [
        ("point_maze", "fixed_std", 1),
        ("ring_peg", "none", 2),
        ("ring_peg", "fixed_std", 1),
    ]
    assert [row["success"] for row in rows] == [0.25, 0.8, 0.5]
    assert [row["difference"] for row in rows] == ["", 0.0, pytest.approx(-0.3)]
    assert (rows[1]["worst"], rows[1]["best"], rows[1]["each"]) == (0.7, 0.9, "0.9000 0.7000")
    text = ablations.markdown(rows)
    assert "| ring_peg | fixed_std: standard deviation stays as it begins | 1 | 5 | 0.500 (0.500) | -0.300 |" in text
    ablations.draw(rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5_000


def test_the_committed_table_is_of_the_committed_runs() -> None:
    rows = [{name: str(value) for name, value in row.items()} for row in ablations.tabulate(RESULTS)]
    assert rows == read(RESULTS / "ablations.csv"), "python -m experiments.ablations train=no renews it"
