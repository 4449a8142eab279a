"""The report's data: what a run recorded, in numbers and places; how its page is put together."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcg_jax.config.settings import ConfigError
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.report import compare, data, points, scenery, write
from rcg_jax.report.__main__ import main
from rcg_jax.report.page import page
from rcg_jax.report.scene import RenderError
from rcg_jax.runs.start_record import MOST_STARTS, read_starts, start_row
from rcg_jax.tasks import make_task
from tests import report_run
from tests.report_run import content


@pytest.fixture(scope="module")
def saved(tiny: Path) -> Path:
    return report_run.save_run(tiny / "runs")


@pytest.fixture(scope="module")
def written(saved: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("page") / "report.html"
    assert write.write_report(saved, out, videos=0) == []
    return content(out)


def unpack(text: str, dtype: str) -> np.ndarray:
    import base64

    return np.frombuffer(base64.b64decode(text), dtype)


class TestRecord:
    def test_what_is_read_is_what_was_there(self, saved: Path) -> None:
        records = list(read_starts(saved / "starts.csv"))
        assert [one.iteration for one in records] == list(range(1, report_run.ITERATIONS + 1))
        for one in records:
            there, labels = report_run.starts(one.iteration)
            np.testing.assert_allclose(one.qpos, there.qpos[:20], atol=5e-4)
            np.testing.assert_array_equal(one.successes, labels.successes[:20])
            np.testing.assert_array_equal(one.episodes, labels.episodes[:20])

    def test_large_numbers_and_sets(self, tmp_path: Path) -> None:
        starts, labels = report_run.far_starts(2 * MOST_STARTS)
        labels = labels.replace(episodes=labels.episodes + 70_000)
        row = start_row(3, starts, labels)
        text = ",".join(row) + "\n" + ",".join(str(cell) for cell in row.values()) + "\n"
        (tmp_path / "starts.csv").write_text(text)
        (one,) = read_starts(tmp_path / "starts.csv")
        assert len(one.qpos) == MOST_STARTS
        assert np.isinf(one.qpos).all()
        assert (one.episodes == 2**16 - 1).all()

    def test_rows_that_cannot_be_read_are_left_out(self, run: Path) -> None:
        lines = (run / "starts.csv").read_text().splitlines()
        lines[2] = lines[2].replace(lines[2].split(",")[2], "AAA")
        lines[3] = lines[3].replace(lines[3].split(",")[2], lines[3].split(",")[2][:-8])
        (run / "starts.csv").write_text("\n".join(lines) + "\n5,20,AA")
        assert [one.iteration for one in read_starts(run / "starts.csv")] == [1, 4, 5, 6]
        assert list(read_starts(run / "none.csv")) == []


class TestPage:
    def test_starts_lie_where_they_were(self, written: dict[str, Any]) -> None:
        starts = written["starts"]
        assert starts["iterations"] == list(range(1, 7))
        assert starts["number"] == [20] * 6
        assert starts["name"] == "the model's “centre”"
        np.testing.assert_allclose(starts["goal"], [0.2, 0, 0.05], atol=1e-6)
        unit = starts["unit"]
        place = unpack(starts["points"], "<i2").reshape(6, 20, 3) * unit["step"] + unit["centre"]
        distance = np.linalg.norm(place - starts["goal"], axis=2)
        np.testing.assert_allclose(distance.mean(axis=1), list(report_run.RADIUS.values()), atol=2e-3)
        kinds = unpack(starts["kinds"], "u1").reshape(6, 20)
        assert [np.bincount(row, minlength=4).tolist() for row in kinds] == [[4, 5, 8, 3]] * 6
        # The ball stays on its table: no view from the side.
        assert [view["title"] for view in starts["views"]] == ["from above"]

    def test_final_success_counts_every_episode_once(self, written: dict[str, Any]) -> None:
        final = written["final"]
        assert (final["all"]["successes"], final["all"]["episodes"]) == (60, 100)
        rows = final["distance"]
        assert (sum(row["successes"] for row in rows), sum(row["episodes"] for row in rows)) == (60, 100)
        low, high = wilson_interval(rows[0]["successes"], rows[0]["episodes"])
        assert (rows[0]["low"], rows[0]["high"]) == pytest.approx((low, high))
        # No start of this task is at the goal.
        assert final["region"] == []
        assert final["steps"] == 20

    def test_text_of_the_user_stays_text(self, written: dict[str, Any]) -> None:
        evil = "</script><script>alert(1)</script><!-- @@PAGE@@ &"
        text = page(evil, {**written, "headline": evil})
        head, _, _ = text.partition("<style>")
        assert "<script" not in head
        assert text.count("<script") == page("fine", written).count("<script")
        assert json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])["headline"] == evil  # type: ignore[index]

    def test_nothing_comes_from_the_network(self, written: dict[str, Any]) -> None:
        text = re.sub(r"https://www\.chartjs\.org|http://www\.w3\.org\S+", "", page("title", written))
        assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//|url\(|@import|sourceMappingURL|fetch\(""", text)


class TestLeftOut:
    def test_no_checkpoint_and_no_evaluation(self, run: Path) -> None:
        shutil.rmtree(run / "checkpoints")
        (run / "eval.csv").unlink()
        left_out = write.write_report(run)
        found = content(run / "report.html")
        assert found["headline"] == "Not evaluated yet after 12 k steps, in 3.0 min"
        assert (found["starts"], found["final"], found["videos"]) == (None, None, [])
        assert found["left_out"] == left_out
        assert "no checkpoint yet" in left_out[0]

    def test_no_way_to_draw(self, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*args: object) -> None:
            raise RenderError("no OpenGL context")

        monkeypatch.setattr(write, "make_videos", fail)
        assert write.write_report(run) == ["no videos: no OpenGL context"]
        assert content(run / "report.html")["starts"]

    def test_runs_of_an_older_version_are_evaluated_again(self, run: Path) -> None:
        (run / "starts.csv").unlink()
        (run / "final_evaluation.csv").unlink()
        (left_out,) = write.write_report(run, videos=0)
        assert "no growth of the starts" in left_out
        final = content(run / "report.html")["final"]
        # 500 episodes of the default settings; the policy succeeds from the goal's left only.
        assert final["all"]["episodes"] == 500
        assert 0 < final["all"]["rate"] < 1


class TestPoints:
    @pytest.mark.parametrize(
        ("name", "point"),
        [
            ("ring_peg", "the centre of the disk"),
            ("key_insertion", "the tip of the key"),
            ("point_maze", "the centre of the ball"),
        ],
    )
    def test_the_tasks_of_the_paper(self, name: str, point: str) -> None:
        task = make_task(name, "native")
        feasible = np.asarray(task.feasible_starts().qpos)[::500]
        locator = points.Locator(task, feasible)
        assert locator.name == point
        goal = task.model.site("goal").pos
        assert np.linalg.norm((locator.goal - goal)[:2]) < 0.03


class TestScenery:
    def test_walls_of_the_maze_in_outline(self) -> None:
        task = make_task("point_maze", "native")
        outlines = [scenery.outline(geom, (0, 1)) for geom in scenery.static_geoms(task.model)]
        # The walls, and no floor.
        assert len(outlines) == len(task.maze.wall_boxes())  # type: ignore[attr-defined]
        for corners, (low, high) in zip(outlines, task.maze.wall_boxes(), strict=True):  # type: ignore[attr-defined]
            np.testing.assert_allclose(corners.min(axis=0), low, atol=1e-6)
            np.testing.assert_allclose(corners.max(axis=0), high, atol=1e-6)


class TestNumbers:
    def test_a_file_that_lost_rows_is_damaged(self, run: Path) -> None:
        assert data.read_run(run).damage == ()
        lines = (run / "metrics.csv").read_text().splitlines(keepends=True)
        (run / "metrics.csv").write_text("".join(lines[:4])[:-9])
        (damage,) = data.read_run(run).damage
        assert "metrics.csv is damaged: it ends at iteration 2, eval.csv at iteration 6" in damage
        (run / "metrics.csv").write_text("".join([*lines[:3], *lines[4:]]))
        (damage,) = data.read_run(run).damage
        assert "after iteration 2 rows are missing" in damage
        (run / "metrics.csv").write_text(lines[0][:20])
        with pytest.raises(ConfigError, match=r"metrics\.csv is damaged"):
            data.read_run(run)


@pytest.fixture(scope="module")
def runs(saved: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("compared")
    for seed, method in ((0, "reverse"), (5, "reverse"), (0, "uniform")):
        report_run.save_run(run_dir, seed=seed, method=method)
    return run_dir / "tiny"


class TestComparison:
    def test_seeds_of_one_setting_get_mean_and_spread(self, runs: Path, tmp_path: Path) -> None:
        out = tmp_path / "c.html"
        assert main([f"run={runs / 'reverse'}", f"run={runs / 'uniform'}", f"out={out}"]) == 0
        found = content(out)
        assert [run["label"] for run in found["runs"]] == ["reverse", "uniform"]
        both, alone = found["runs"]
        np.testing.assert_allclose(both["evaluations"]["success_stochastic"], [0.225, 0.425, 0.625])
        np.testing.assert_allclose(both["evaluations"]["success_stochastic_low"], [0.2, 0.4, 0.6])
        np.testing.assert_allclose(both["evaluations"]["success_stochastic_high"], [0.25, 0.45, 0.65])
        np.testing.assert_allclose(alone["evaluations"]["success_stochastic_low"][-1], wilson_interval(60, 100)[0])
        row = found["table"][0]
        assert row["seeds"] == [0, 5]
        assert (row["mean"], row["deviation"]) == (pytest.approx(0.625), pytest.approx(np.std([0.6, 0.65], ddof=1)))
        assert found["differences"] == {"names": ["method"], "rows": [["reverse", "reverse"], ["uniform", "uniform"]]}
        assert found["headline"] == "reverse 62.5 % (2 seeds) · uniform 60 % (1 seed)"
        assert [run["method"] for run in found["runs"]] == ["reverse", "uniform"]
        assert [row["unfinished"] for row in found["table"]] == ["", ""]

    def test_unfinished_seeds_are_counted_apart(self, runs: Path, tmp_path: Path) -> None:
        folder = Path(shutil.copytree(runs / "reverse", tmp_path / "reverse"))
        for name, rows in (("metrics.csv", 4), ("eval.csv", 2)):
            lines = (folder / "seed5" / name).read_text().splitlines()
            (folder / "seed5" / name).write_text("\n".join(lines[: rows + 1]) + "\n")
        compare.write_comparison(compare.find_runs([folder, runs / "uniform"]), tmp_path / "c.html")
        found = content(tmp_path / "c.html")
        row = found["table"][0]
        assert row["unfinished"] == "1 of 2 unfinished (4 of 6 iterations)"
        assert (row["rates"], row["seeds"], row["not_done"], row["deviation"]) == ([0.6], [0], [5], None)
        np.testing.assert_allclose(found["runs"][0]["evaluations"]["success_stochastic"], [0.2, 0.4, 0.6])
        assert found["headline"] == "reverse 60 % (1 seed, 1 more unfinished) · uniform 60 % (1 seed)"
        # Alone it is shown, but ranks behind what is finished.
        compare.write_comparison([folder / "seed5", runs / "uniform" / "seed0"], tmp_path / "c.html")
        assert content(tmp_path / "c.html")["headline"] == "uniform 60 % (1 seed) · reverse 45 % (1 seed, unfinished)"
