"""What the scripts say about trained policies, on a small task with known answers, and the page with their tables."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import tiny_run
from experiments.cross_check import Held, Physics
from PIL import Image

import rcg_jax
from experiments import any_policy, cross_check, failures, horizon, separate
from experiments.common import RESULTS, ResultsError, read, write_rows
from experiments.paper import pages as results_page
from experiments.paper import results_table
from rcg_jax.config.names import TASKS
from rcg_jax.report.scene import RenderError
from rcg_jax.rl.episodes import Episodes
from rcg_jax.runs.load import load_run
from rcg_jax.tasks import make_task

DATA = Path(rcg_jax.__file__).parent / "data"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evidence")


@pytest.fixture(scope="module")
def run_dir(folder: Path):
    """A run whose policy succeeds from starts on the goal's left, at the same y, and only from those."""
    with pytest.MonkeyPatch.context() as patch:
        tiny_run.register(folder, patch)
        yield tiny_run.save_run(folder / "runs")


def call(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", [module.__name__, *words])
    return module.main()


class TestCrossCheck:
    def test_other_physics_leave_the_task_alone(self, run_dir: Path) -> None:
        task = make_task("tiny", "native")
        before = task.model.opt.iterations, task.model.opt.timestep, task.engine
        changed = Physics("fine", "native", {"iterations": 7, "tolerance": 1e-12}, substeps=4).apply(task)
        assert (changed.model.opt.iterations, changed.engine.model.opt.iterations) == (7, 7)
        assert changed.engine.model.opt.timestep == pytest.approx(task.model.opt.timestep / 4)
        assert (task.model.opt.iterations, task.model.opt.timestep, task.engine) == before
        assert (changed.horizon, changed.obs_dim) == (task.horizon, task.obs_dim)
        assert Physics("as trained", "native").apply(task) is task

    def test_a_held_action_is_that_many_steps(self, run_dir: Path) -> None:
        task = make_task("tiny", "native")
        state = task.reset(task.feasible_starts().take(np.arange(3)))
        ctrl = np.full((3, 2), 1.5, np.float32)
        by_hand = state
        for _ in range(3):
            by_hand = task.engine.step(by_hand, ctrl)
        held = Held(task.engine, 3).step(state, ctrl)
        np.testing.assert_array_equal(held.qpos, by_hand.qpos)
        assert not np.array_equal(held.qpos, state.qpos)

    def test_episodes_beside_the_same_episodes(self) -> None:
        first = Episodes(success=np.array([1, 1, 1, 0, 0], bool), length=np.array([5, 6, 7, 9, 9]), bad=np.zeros(5))
        other = Episodes(success=np.array([1, 1, 0, 1, 0], bool), length=np.array([5, 8, 9, 3, 9]), bad=np.zeros(5))
        cells = cross_check.compare(first, other)
        assert (cells["successes"], cells["only_as_trained"], cells["only_here"]) == (3, 1, 1)
        assert (cells["outcome_differs"], cells["steps_differ"], cells["intervals_overlap"]) == (0.4, 0.5, "yes")
        assert cells["sign_test_p"] == 1.0
        none = Episodes(success=np.zeros(100, bool), length=np.full(100, 9), bad=np.zeros(100))
        every = Episodes(success=np.ones(100, bool), length=np.full(100, 9), bad=np.zeros(100))
        cells = cross_check.compare(every, none)
        assert (cells["intervals_overlap"], cells["only_as_trained"]) == ("no", 100)
        assert cells["sign_test_p"] < 1e-20

    def test_rows_of_a_run(self, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        write_rows(tmp_path / "cross_check.csv", [{"policy": "another", "task": "tiny"}])
        # Gravity along y is what the policy knows nothing of.
        windy = Physics("windy", "native", {"gravity": [0.0, 3.0, 0.0]})
        monkeypatch.setattr(cross_check, "variants", lambda engine: [Physics("as trained", engine), windy])
        monkeypatch.setattr(cross_check, "markdown", lambda rows: "")
        assert call(cross_check, monkeypatch, f"run={run_dir}", "episodes=200", f"results={tmp_path}") == 0
        rows = read(tmp_path / "cross_check.csv")
        assert [row["policy"] for row in rows] == ["another", *["tiny/reverse/seed0"] * 4]
        usual, other = rows[2], rows[4]
        assert (usual["physics"], usual["actions"], other["physics"], other["actions"]) == (
            "as trained", "mean", "windy", "mean")  # fmt: skip
        assert float(usual["outcome_differs"]) == 0
        assert float(other["outcome_differs"]) > 0.05
        assert other["command"].startswith("python -m ")

    @pytest.mark.parametrize(
        ("words", "line"),
        [
            (["policy=point_maze", "run=x"], "policy=point_maze run=x: one of them, not both"),
            (["run=nowhere"], "run=nowhere: no such folder"),
            (["policy=nothing"], "policy=nothing: "),
            (["episodes=0"], "episodes=0: must be an integer >= 1"),
        ],
    )
    def test_refusals(
        self, words: list[str], line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        try:
            code = call(cross_check, monkeypatch, *words)
        except SystemExit as end:
            code = int(str(end.code))
        assert code == 2
        assert capsys.readouterr().err.startswith(f"error: {line}")


class TestHorizon:
    def test_success_within_so_many_steps(self) -> None:
        arrival = {"stochastic": np.array([30.0, 90, 150, np.inf]), "mean": np.array([10.0, 10, 400, 401])}
        rows = horizon.success_rows(arrival, 100, np.array([0.05, 0.05, 0.15, 0.15]), {"at_goal": np.zeros(4, bool)})
        all_rows = {(row["steps"], row["actions"]): row for row in rows if row["region_kind"] == "all"}
        assert len(all_rows) == 2 * horizon.LONGEST * horizon.POINTS
        assert [all_rows[t, "stochastic"]["successes"] for t in (20, 30, 100, 150, 400)] == [0, 1, 2, 3, 3]
        assert [all_rows[t, "mean"]["successes"] for t in (10, 390, 400)] == [2, 2, 3]
        far = [row for row in rows if row["region"] == "0.1-0.2" and row["actions"] == "stochastic"]
        assert [(row["horizons"], row["successes"], row["episodes"]) for row in far] == [
            (1, 0, 2),
            (2, 1, 2),
            (4, 1, 2),
        ]

    def test_a_run_and_its_picture(self, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert call(horizon, monkeypatch, f"run={run_dir}", "episodes=150") == 0
        rows = [row for row in read(run_dir / "horizon.csv") if (row["region"], row["actions"]) == ("all", "mean")]
        rates = [float(row["success"]) for row in rows]
        assert rates == sorted(rates)
        # T alone is what the evaluation of the run says, from the same starts.
        loaded = load_run(run_dir)
        once = horizon.play(loaded, loaded.task, episodes=150, seed=0)
        (at_t,) = [float(row["success"]) for row in rows if float(row["horizons"]) == 1]
        assert at_t == pytest.approx(float(once.successes_mean) / 150, abs=1e-4)
        first = (run_dir / "horizon.png").read_bytes()
        assert call(horizon, monkeypatch, "draw=1", f"results={run_dir}") == 0
        assert (run_dir / "horizon.png").read_bytes() == first
        assert "| tiny/reverse/seed0 | 1 s | 150 |" in horizon.markdown(read(run_dir / "horizon.csv"))


class TestAnyPolicy:
    def test_a_start_counts_once_whoever_arrives(self) -> None:
        plays = [  # of two policies, with noise and with mean actions, from four starts
            [[1, 0, 0, 0], [1, 1, 0, 0]],
            [[1, 1, 0, 0], [1, 0, 1, 0]],
        ]
        found = any_policy.summary(np.array(plays, bool))
        assert (found["policies"], found["episodes"], found["successes"], found["success"]) == (2, 4, 3, 0.75)
        assert (found["always"], found["single_stochastic"], found["best_stochastic"]) == (0.25, 0.375, 0.5)
        assert (found["single_mean"], found["best_mean"]) == (0.5, 0.5)

    def test_runs_and_their_row(self, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        words = ("episodes=80", f"results={tmp_path}")
        assert call(any_policy, monkeypatch, f"run={run_dir},{run_dir}", *words) == 0
        (row,) = read(tmp_path / "any_policy.csv")
        loaded = load_run(run_dir)
        once = horizon.play(loaded, loaded.task, episodes=80, seed=0)
        either = once.stochastic.success | once.mean.success  # twice the same policy: the union is that of its actions
        assert (row["policy"], row["policies"], int(row["successes"])) == ("tiny", "2", int(either.sum()))
        assert 0 < int(row["successes"]) < 80
        assert f"| tiny | 2 | 80 | {float(row['single_stochastic']):.3f}," in any_policy.markdown([row])

    def test_policies_that_do_not_fit(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
        for words, said in (
            ((), "policy=none run=none: give one of them"),
            (("policy=ring_peg", "run=runs"), "policy=ring_peg run=runs: give one of them"),
            (("policy=ring_peg,point_maze",), "policies of point_maze, ring_peg: must be of one task"),
            (("run=nowhere",), "nowhere"),
        ):
            assert call(any_policy, monkeypatch, *words, f"results={tmp_path}") == 2
            assert said in capsys.readouterr().err
        assert not (tmp_path / "any_policy.csv").exists()


class TestFailures:
    def test_the_coordinates_that_tell_failures(self) -> None:
        rng = np.random.default_rng(0)
        qpos = rng.uniform(-1, 1, (2000, 4))
        failed = (qpos[:, 2] > 0.5) & (rng.uniform(size=2000) < 0.9)
        failed |= (qpos[:, 2] < 0.5) & (np.abs(qpos[:, 0]) < 0.25) & (rng.uniform(size=2000) < 0.5)
        first, second = separate.separate(qpos, failed)
        assert (first.coordinate, second.coordinate) == (2, 0)
        inside = first.inside(qpos)
        assert np.mean(inside == (qpos[:, 2] > 0.5)) > 0.98
        assert first.words("pan").startswith("pan > 0.")
        # The second range lies among the starts outside the first.
        assert not (second.inside(qpos) & inside).any()
        assert second.words("lift").startswith("lift -0.2")
        words = separate.as_words(["lift", "b", "pan", "d"], [first, second], qpos, failed)
        assert words[0].endswith("of all failures")
        assert words[1].startswith("of the other starts, lift")

    def test_chance_is_no_reason(self) -> None:
        rng = np.random.default_rng(1)
        assert separate.separate(rng.uniform(size=(500, 9)), rng.uniform(size=500) < 0.3) == []
        assert separate.separate(rng.uniform(size=(500, 2)), np.zeros(500, bool)) == []

    def test_typical_points(self) -> None:
        rng = np.random.default_rng(0)
        points = np.concatenate([rng.normal([0, 0], 0.1, (60, 2)), rng.normal([9, 9], 0.1, (20, 2))])
        rows, shares = separate.typical(points, 2)
        assert shares.tolist() == [0.75, 0.25]
        assert rows[0] < 60 <= rows[1]
        assert [len(x) for x in separate.typical(points[:1], 4)] == [1, 1]

    def test_a_run(self, run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        assert call(failures, monkeypatch, f"run={run_dir}", "episodes=300") == 0
        rows = read(run_dir / "failures.csv")
        whole = next(row for row in rows if (row["region"], row["actions"]) == ("all", "stochastic"))
        assert (whole["share_of_starts"], whole["share_of_failures"]) == ("1.0", "1.0")
        ranges = [row for row in rows if (row["region_kind"], row["actions"]) == ("range", "stochastic")]
        assert ranges
        # Whatever the ranges are, they hold more than their share of the failures, and the bins add up.
        assert all(float(row["share_of_failures"]) > float(row["share_of_starts"]) for row in ranges)
        name = ranges[0]["region"].split(" ")[0]
        bins = [row for row in rows if row["region"].startswith(f"{name} ") and row["region_kind"] == "coordinate"
                and row["actions"] == "mean"]  # fmt: skip
        assert sum(int(row["episodes"]) for row in bins) == int(whole["episodes"])
        picture = Image.open(run_dir / "failures_tiny_reverse_seed0.png")
        assert picture.width == 1300
        assert "| tiny/reverse/seed0 |" in capsys.readouterr().out

    def test_without_opengl_there_is_a_picture_without_scenes(
        self, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def fail(*_: object) -> None:
            raise RenderError("no OpenGL context")

        monkeypatch.setattr(failures, "open_scene", fail)
        assert call(failures, monkeypatch, f"run={run_dir}", "episodes=60", f"results={tmp_path}") == 0
        assert "without pictures of the starts: no OpenGL context" in capsys.readouterr().out
        assert (tmp_path / "failures_tiny_reverse_seed0.png").exists()


class TestPage:
    def test_tables_between_comments_are_replaced(self, tmp_path: Path) -> None:
        row = {"reach_rad": 0.5, "reach_of_motors": 1.0, "share": 0.97, "command": "python -m x", "commit": "123"}
        write_rows(tmp_path / "ring_reach.csv", [row])
        page = "a\n<!-- table: ring_reach -->\nold\n<!-- end -->\nb\n<!-- table: horizon -->\nkept\n<!-- end -->\n"
        new = results_page.renewed(page, tmp_path)
        assert "old" not in new
        assert "| 0.50 rad | 1.0 | 0.97 |" in new
        assert "Measured by `python -m x` at 123." in new
        assert "\nkept\n" in new
        assert results_page.renewed(new, tmp_path) == new
        with pytest.raises(ResultsError, match="table: nothing: must be one of"):
            results_page.renewed("<!-- table: nothing -->\n<!-- end -->", tmp_path)

    def test_commands_for_one_change_each_are_one(self, tmp_path: Path) -> None:
        row = {"reach_rad": 0.5, "reach_of_motors": 1.0, "share": 0.97}
        made = [("run change=a seed=0", "1"), ("run change=b seed=0", "1"), ("run change=c seed=0", "2"), ("run", "1")]
        rows = [{**row, "command": command, "commit": commit} for command, commit in made]
        write_rows(tmp_path / "ring_reach.csv", rows)
        new = results_page.renewed("<!-- table: ring_reach -->\n<!-- end -->", tmp_path)
        assert [line for line in new.splitlines() if line.startswith("Measured")] == [
            "Measured by `run change=a,b seed=0` at 1.",
            "Measured by `run change=c seed=0` at 2.",
            "Measured by `run` at 1.",
        ]

    def test_the_committed_pages_have_the_committed_numbers(self) -> None:
        pages = {name: (results_page.ROOT / name).read_text() for name in results_page.PAGES}
        text = pages["docs/results.md"]
        assert {name for name in results_page.TABLES if f"<!-- table: {name} -->" in text} == set(results_page.TABLES)
        for text in pages.values():
            assert results_page.renewed(text, RESULTS) == text, "make figures renews it"

    def test_committed_runs_started_where_the_task_says(self) -> None:
        cards = {task: json.loads((DATA / f"{task}.json").read_text())["sha256"] for task in TASKS}
        rows = read(RESULTS / "runs.csv")
        assert [row["command"] for row in rows if row["starts_sha256"] != cards[row["task"]]] == []

    def test_the_committed_table_is_of_the_committed_runs(self, tmp_path: Path) -> None:
        for path in RESULTS.glob("*.csv"):
            shutil.copy(path, tmp_path)
        results_table.write(tmp_path)
        written, committed = (folder / "results.csv" for folder in (tmp_path, RESULTS))
        assert read(written) == read(committed), "make figures renews it"
