"""From run folders to CSV files to figures: the numbers on the way, and what a figure says about missing runs."""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from rcg_jax.runs.task_settings import with_task_settings

from experiments import uniform_failure as uniform
from experiments.common import read, write_rows
from experiments.paper import (
    collect,
    curves,
    distance_reward,
    figures,
    good_starts,
    learning_curves,
    results_table,
    style,
)
from experiments.paper.plan import Curve
from rcg_jax.config.settings import Config, flatten
from rcg_jax.io.tables import CsvLog
from rcg_jax.runs import checkpoint
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.recorder import EVAL_COLUMNS
from rcg_jax.runs.settings import read_config, read_values, task_attributes
from rcg_jax.tasks import TASKS, AntMaze, RingPeg, make_task
from rcg_jax.train_step import init_train_state

COLUMNS = ["iteration", "env_steps", "success", "share_low", "share_good", "share_high", "labelled", "proposal_steps"]


def write_run(root: Path, seed: int, success: dict[int, float], iterations: int, **settings: Any) -> RunFolder:
    """A run of 10 steps an iteration, whose share of good starts is its iteration / 100."""
    config = dataclasses.replace(Config(task="ring_peg", engine="native", iterations=iterations), **settings)
    folder = RunFolder(dataclasses.replace(config, run_dir=str(root)), seed)
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
    write_run(runs, 0, {4: 0.5}, 4, method="all_starts")
    for seed in (0, 1):
        write_run(runs / "d", seed, {4: 0.1}, 4, reward="distance")
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


def test_long_runs_are_thinned_to_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "STRETCHES", 4)
    run = write_run(tmp_path, 0, {5: 0.5}, 10)
    rows = collect.curve_rows(run.path, {})
    assert [row["iteration"] for row in rows] == [3, 5, 6, 9, 10]
    assert [row["share_good"] for row in rows] == [0.02, 0.045, 0.06, 0.08, 0.1]
    assert rows[-1]["proposal_steps"] == 70


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
    trpo = dataclasses.replace(Config().trpo, max_kl=0.02)
    write_run(more / "c", 0, {4: 0.3}, 4, trpo=trpo)
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


def test_a_run_with_a_setting_that_there_is_no_more_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing that this version says of its settings, and no command, would be true."""
    run = write_run(tmp_path / "runs", 0, {2: 0.5}, 2)
    text = run.config_file.read_text()
    assert "  full_step_failures: 0.1\n" in text
    run.config_file.write_text(text.replace("full_step_failures", "mastered_failures"))
    assert collect.find(tmp_path) == {}
    assert "with trpo.mastered_failures=0.1, which there is no more" in capsys.readouterr().err


def test_rows_of_earlier_defaults_are_not_taken_for_runs_of_the_present_ones(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As a program sees it whose default of a setting is another one than these runs'.
    earlier = collect.present("default", "ring_peg")
    for module in (collect, curves):
        monkeypatch.setattr(module, "present", lambda preset, task, guided=False: "0123abcd")
    (reverse,) = [each for each in curves.load("ring_peg", results) if each.curve == Curve("ring_peg", "reverse")]
    assert (reverse.config, reverse.of_today, reverse.others) == (earlier, False, 0)
    assert f"other defaults than today's: ring_peg reverse ({earlier})" in curves.sources([reverse], results)[0]
    # A single run of today's comes before three of others.
    path = results / "curves_ring_peg.csv"
    text = path.read_text()
    new = [
        line.replace(earlier, "0123abcd") for line in text.splitlines() if line.startswith("reverse,sparse,default,1")
    ]
    path.write_text(text + "".join(f"{line}\n" for line in new))
    (reverse,) = [each for each in curves.load("ring_peg", results) if each.curve == Curve("ring_peg", "reverse")]
    assert (list(reverse.runs), reverse.of_today, reverse.others) == ([1], True, 3)
    assert "not drawn: ring_peg reverse 3" in curves.sources([reverse], results)[0]


def test_the_digest_is_of_what_is_learned() -> None:
    def of(**settings: Any) -> str:
        config = dataclasses.replace(Config(), **settings)
        return collect.digest({name: value for name, _, value in flatten(config)} | task_attributes("point_maze"))

    assert (
        of()
        == of(seed=3, iterations=7, run_dir="x", engine="mjx", task="ring_peg")
        == collect.present("default", "point_maze")
    )
    assert of(devices="all", matmul_precision="default") == of(), "rounding is not what is learned"
    assert of(trpo=dataclasses.replace(Config().trpo, max_kl=0.02)) != of()
    earlier = {name: value for name, _, value in flatten(Config()) if name != "curriculum.stall_walk"}
    assert collect.digest(earlier) == of(), "a setting that came later, and is off"
    assert of(curriculum=dataclasses.replace(Config().curriculum, stall_walk=10)) != of()


def test_the_digest_is_of_what_the_task_sets_for_itself_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it was when the run was made, which its folder says."""
    monkeypatch.setattr(RingPeg, "rho_0_share", 0.5)
    monkeypatch.setattr(AntMaze, "rho_0_share", 0.5)
    collect.present.cache_clear()

    def of(task: str, **settings: Any) -> str:
        config = dataclasses.replace(Config(), task=task, run_dir=str(tmp_path), **settings)
        folder = RunFolder(config, 0)
        folder.open()
        folder.write_config()
        folder.close()
        held = config.policy.action_repeat or TASKS[task].action_repeat
        share = TASKS[task].rho_0_share if config.curriculum.rho_0_share < 0 else config.curriculum.rho_0_share
        assert read_config(folder.path) == dataclasses.replace(
            config,
            policy=dataclasses.replace(config.policy, action_repeat=held),
            curriculum=dataclasses.replace(config.curriculum, rho_0_share=share),
        )
        return collect.digest(read_values(folder.config_file))

    ring, ant = of("ring_peg"), of("ant_maze")
    assert ring == collect.present("default", "ring_peg")
    asked = with_task_settings(Config(task="ant_maze"), ())
    assert of("ant_maze", trpo=asked.trpo, baseline=asked.baseline) == collect.present("default", "ant_maze") != ant
    point = of("point_maze")
    assert len({ring, point, ant}) == 3
    every, fourth = (dataclasses.replace(Config().policy, action_repeat=k) for k in (1, 4))
    without, half = (dataclasses.replace(Config().curriculum, rho_0_share=share) for share in (0.0, 0.5))
    assert of("ring_peg", policy=every, curriculum=without) == point, "as before there was a choice"
    assert of("ring_peg", policy=fourth) == of("point_maze", policy=fourth, curriculum=half) == ring
    assert of("ring_peg", curriculum=without) == of("key_insertion")
    assert of("point_maze", curriculum=without) == point != of("point_maze", curriculum=half)
    assert of("ant_maze", curriculum=half) == ant != of("ant_maze", curriculum=without)
    set_std = dataclasses.replace(Config().policy, init_std=0.7)
    before = of("ant_maze", policy=set_std)
    made = tmp_path / "ant_maze" / "reverse" / "seed0" / "config.yaml"
    of("ant_maze")
    monkeypatch.setattr(AntMaze, "init_std", 1.0)
    assert collect.digest(read_values(made)) == ant, "the folder's, not the class's"
    assert of("ant_maze", policy=set_std) == before, "a setting overrides the class's"
    assert of("ant_maze") not in (ring, ant)
    monkeypatch.setattr(AntMaze, "settle_steps", 0)
    assert of("ant_maze") == of("point_maze", curriculum=half)
    monkeypatch.setattr(AntMaze, "rho_0_share", 0.0)
    assert of("ant_maze") == point
    collect.present.cache_clear()


def test_a_run_says_how_long_actions_were_held_only_where_that_was_set() -> None:
    def of(task: str, repeat: int) -> list[str]:
        config = dataclasses.replace(Config(), task=task)
        return collect.changed(
            dataclasses.replace(config, policy=dataclasses.replace(config.policy, action_repeat=repeat))
        )

    assert of("ring_peg", 4) == of("point_maze", 1) == of("gone.py:Task", 1) == []
    assert of("ring_peg", 1) == ["policy.action_repeat=1"]
    assert of("gone.py:Task", 4) == ["policy.action_repeat=4"]


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
        (lambda text: text.replace(",sparse,default,0,", ",sparse,default,x,", 1), "seed=x: must be a number"),
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


def test_legends_have_what_is_drawn_and_panels_what_is_not(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Figure] = []
    monkeypatch.setattr(style, "save", lambda figure, path: kept.append(figure) or path)
    for draw in (learning_curves.draw, good_starts.draw, distance_reward.draw):
        draw(results)
    for figure, labels in zip(kept, (["reverse", "all_starts"], ["reverse", "all_starts"], None), strict=True):
        shown = [text.get_text() for text in figure.legends[0].get_texts()]
        assert shown == (
            [style.label(name) for name in labels]
            if labels
            else ["reverse curriculum, sparse reward", "reverse curriculum, distance reward"]
        )
    words = next(axes.get_xlabel() for axes in kept[0].axes if axes.get_title(loc="left") == "Ring on peg")
    assert "seeds: reverse 2, all_starts 1\nnot run yet: uniform" in words
    assert "uniform sparse, uniform distance" in kept[2].axes[0].get_xlabel()


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


def test_without_runs_there_is_no_table(tmp_path: Path) -> None:
    assert results_table.write(tmp_path) == []
    assert not (tmp_path / "results.csv").exists()


def test_what_is_missing_is_said_with_its_command(results: Path) -> None:
    _, lacking = learning_curves.draw(results)
    ring = next(line for line in lacking if line.startswith("ring_peg"))
    assert "reverse (seeds 3,4)" in ring
    assert "uniform (all seeds)" in ring
    assert ring.endswith('make reproduce BUDGET=cpu ARGS="task=ring_peg"')
    _, lacking = distance_reward.draw(results)
    assert "reverse reward=distance (seeds 2,3,4)" in next(line for line in lacking if line.startswith("ring_peg"))


def test_small_print_says_what_the_numbers_come_from(results: Path) -> None:
    text, few = curves.sources(curves.load("ring_peg", results), results)
    assert text.startswith("6 runs; engine native; preset=default; commit 1234abc; ")
    rows = read(results / "runs.csv")
    write_rows(results / "runs.csv", [{**row, "device": "Abacus" if k < 2 else ""} for k, row in enumerate(rows)])
    assert "Abacus, machine of 4 of them not recorded." in curves.sources(curves.load("ring_peg", results), results)[0]
    assert few.startswith("Fewer than 5 seeds in the mean: ring_peg all_starts 1, ring_peg reverse reward=distance 2,")


def test_all_figures_are_drawn_from_what_there_is(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["figures", "only=table,fig2,fig3,fig5,fig6,uniform", f"results={results}"])
    assert figures.main() == 0
    out = capsys.readouterr().out
    for name in ("fig2_learning_curves", "fig3_good_starts", "fig5_distance_reward"):
        image = np.asarray(Image.open(results / f"{name}.png").convert("RGB")).reshape(-1, 3)
        wanted = np.array([int(style.colour("reverse")[k : k + 2], 16) for k in (1, 3, 5)])
        assert (np.abs(image.astype(int) - wanted).max(axis=1) < 4).sum() > 100, f"{name} has no line of that colour"
    assert "fig6: synthetic_bob.csv is not there: python -m experiments.synthetic_bob" in out
    assert "uniform: point_maze lacks maps of uniform (all seeds)" in out
    assert not (results / "uniform_failure.png").exists()
    for word, says in (("only=fig9", "only=fig9: fig9 is none of"), (f"results={results / 'none'}", "no such folder")):
        monkeypatch.setattr("sys.argv", ["figures", word])
        assert figures.main() == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert says in line
    assert not (results / "none").exists()


def test_without_any_runs_nothing_is_drawn(tmp_path: Path) -> None:
    for draw in (learning_curves.draw, good_starts.draw, distance_reward.draw):
        path, lacking = draw(tmp_path)
        assert path is None
        assert lacking


def test_published_curves_are_complete() -> None:
    for task, ends in {"ring_peg": (0.45, 0.39, 0.12), "key_insertion": (0.52, 0.31, 0.03)}.items():
        found = learning_curves.published(task)
        assert tuple(found[method][-1, 1] for method in ("reverse", "all_starts", "uniform")) == ends
        assert all((rows[:, 0] == sorted(rows[:, 0])).all() and rows[-1, 0] == 2000 for rows in found.values())
    assert learning_curves.published("point_maze") == {}


def test_map_of_a_policy_that_pushes_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = Config(task="point_maze", method="uniform", engine="native", iterations=6, run_dir=str(tmp_path))
    folder = RunFolder(config, 3)
    folder.path.mkdir(parents=True)
    folder.write_config()
    state = init_train_state(folder.config, make_task("point_maze", "native"), 3)
    push = jax.tree.map(jnp.zeros_like, state.agent.policy.mlp)
    last = max(push["params"])
    push["params"][last]["bias"] = jnp.array([0.5, 0.0])
    policy = state.agent.policy.replace(mlp=push, log_std=jnp.full(2, -9.0))
    state = state.replace(agent=state.agent.replace(policy=policy), iteration=jnp.int32(6))
    checkpoint.save([folder.checkpoints], 6, [state])
    unfinished = RunFolder(dataclasses.replace(folder.config, iterations=7), 4)
    checkpoint.save([unfinished.checkpoints], 6, [state])
    unfinished.write_config()
    broken = RunFolder(config, 5)
    broken.path.mkdir(parents=True)
    broken.config_file.write_text("task: [")
    table = tmp_path / "policy_point_maze.csv"
    assert uniform.measure_all(tmp_path, "point_maze", 2, table) == 1
    said = capsys.readouterr()
    assert "seed4: left out: 6 of 7 iterations" in said.out
    assert "seed5: left out: " in said.err
    rows = read(table)
    assert {row["config"] for row in rows} == {collect.present("default", "point_maze")}
    assert len(rows) == 17 * uniform.LATTICE**2
    assert {(row["action_x"], row["action_y"]) for row in rows} == {("0.5", "0.0")}
    # The goal is in the upper corridor's right end: the rows of the lattice beside its height reach it.
    solved = {(float(row["x"]), float(row["y"])) for row in rows if int(row["successes"]) == 2}
    assert {y for _, y in solved} <= {3.75, 4.25}
    assert (-3.75, 3.75) in solved
    path, lacking = uniform.draw(tmp_path)
    assert path is not None
    assert path.stat().st_size > 10_000
    assert "uniform (seeds 0,1,2,4)" in lacking[0]
    height = Image.open(path).height
    # Maps of the paper's values get rows of their own.
    paper = [
        {**row, "method": "reverse", "preset": "paper", "config": collect.present("paper", "ring_peg")} for row in rows
    ]
    write_rows(table, rows + paper)
    path, lacking = uniform.draw(tmp_path)
    assert path is not None
    assert Image.open(path).height > 1.3 * height
    assert "reverse preset=paper (seeds 0,1,2,4)" in lacking[0]


def test_no_folder_to_measure_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, says in ((tmp_path / "none", "no such folder"), (tmp_path, "no finished uniform or reverse runs")):
        monkeypatch.setattr("sys.argv", ["uniform_failure", f"run_dir={folder}", f"results={tmp_path / 'out'}"])
        assert uniform.main() == 2
        assert says in capsys.readouterr().err


def test_curves_that_figures_show_are_those_that_are_trained() -> None:
    fig3 = curves.needed(lambda c: c.task in ("ring_peg", "key_insertion") and c.method == "all_starts")
    assert Curve("ring_peg", "all_starts") in fig3
    assert Curve("ring_peg", "all_starts", preset="paper") in fig3
