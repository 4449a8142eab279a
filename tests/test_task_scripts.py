"""The pictures and the table of tasks, on a small task with known answers."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from PIL import Image, ImageSequence

from experiments import task_table
from experiments.benchmarks import raw_physics
from experiments.paper import moving_picture, task_pictures
from rcg_jax.io.starts_file import load_starts
from rcg_jax.policies.policy_file import shipped_policies
from rcg_jax.report.scene import RenderError
from rcg_jax.tasks import TASKS, make_task

#: The ball touches the table in every step: one pair, one point.
TOUCHING = (
    '<geom type="sphere"',
    '<geom name="ball" type="sphere"',
    '<geom type="plane"',
    '<geom name="table" contype="0" conaffinity="0" type="plane"',
    "<actuator>",
    '<contact><pair geom1="table" geom2="ball" condim="1" margin="0.01"/></contact><actuator>',
)
SMALL = ["tasks=tiny", "batch=16", "steps=2", "repeats=1", "contact_steps=10", "agree_steps=5"]


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    tiny_run.register(tmp_path, monkeypatch)
    text = tiny_run.XML
    for old, new in zip(TOUCHING[::2], TOUCHING[1::2]):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "tiny.xml").write_text(text)
    return tmp_path


def run(module, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", [module.__name__, *words])
    return module.main()


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class TestTable:
    def test_contacts_of_a_ball_on_a_table(self, tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert run(task_table, monkeypatch, *SMALL, "what=contacts", f"out={tiny / 'tasks.csv'}") == 0
        (row,) = rows(tiny / "tasks.csv")
        assert (row["task"], row["nq"], row["nu"]) == ("tiny", "2", "2")
        assert (row["geom_pairs"], row["candidate_contacts"], row["mjx_solver"]) == ("1", "1", "own")
        assert (float(row["contacts_per_step"]), float(row["share_touching"])) == (1.0, 1.0)

    def test_engines_that_agree_and_engines_that_do_not(self, tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        chosen = task_table.TableOptions(batch=16, agree_steps=5)
        found = task_table.agreement("tiny", chosen)
        assert 0 <= found["dq_median"] <= found["dq_99"] <= found["dq_max"] < 1e-6
        assert found["nonfinite"] == 0

        def stronger(name, engine):
            task = make_task(name, engine)
            task.model.actuator_ctrlrange[:] *= 2 if engine == "native" else 1
            return task

        monkeypatch.setattr(task_table, "make_task", stronger)
        assert task_table.agreement("tiny", chosen)["dq_median"] > 1e-4

    def test_a_row_grows_part_by_part_and_leaves_the_others_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "tasks.csv"
        task_table.merge(path, "own.py:Mine", {"a": 1})
        task_table.merge(path, "ring_peg", {"b": 0.123456})
        task_table.merge(path, "own.py:Mine", {"c": 3})
        task_table.merge(path, "ring_peg", {"b": 0.5})
        found = rows(path)
        assert [row["task"] for row in found] == ["ring_peg", "own.py:Mine"]
        assert [(row["a"], row["b"], row["c"]) for row in found] == [("", "0.5", ""), ("1", "", "3")]
        assert all(row["command"] and row["jax"] for row in found)

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (["what=speed"], "what=speed: must be one of contacts, physics, compile, agreement"),
            (["tasks=maze"], "task=maze: must be one of"),
            (["--batch", "4"], "--batch"),
            (["batch=0"], "batch=0: must be an integer >= 1"),
        ],
    )
    def test_refusals(self, words, says, tmp_path, monkeypatch, capsys) -> None:
        try:
            code = run(task_table, monkeypatch, *words, f"out={tmp_path / 'tasks.csv'}")
        except SystemExit as stop:
            code = stop.code
        assert code == 2
        assert says in capsys.readouterr().err
        assert not list(tmp_path.iterdir())

    @pytest.mark.slow
    def test_all_parts(self, tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert run(task_table, monkeypatch, *SMALL, f"out={tiny / 'tasks.csv'}") == 0
        (row,) = rows(tiny / "tasks.csv")
        assert list(row)[-1] == "command"
        for column in ("native_steps_per_s", "mjx_steps_per_s", "mjx_stock_steps_per_s", "compile_mjx_s"):
            assert float(row[column]) > 0
        assert float(row["mjx_of_native"]) == pytest.approx(
            float(row["mjx_steps_per_s"]) / float(row["native_steps_per_s"]), rel=1e-2
        )


class TestPictures:
    def test_goal_states_and_starts(self, tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
        out = tiny / "pictures"
        assert run(task_pictures, monkeypatch, "tasks=tiny,ring_peg", f"results={out}") == 0
        said = capsys.readouterr().out
        if "no OpenGL context" in said:
            pytest.skip(said)
        assert sorted(path.name for path in out.iterdir()) == ["starts_ring_peg.png", "starts_tiny.png", "tasks.png"]
        for path in out.iterdir():
            assert path.stat().st_size < 300_000
            columns = 2 if path.name == "tasks.png" else 3
            assert Image.open(path).width == columns * task_pictures.WIDTH
        ball = np.asarray(Image.open(out / "starts_tiny.png").convert("RGB"), int)
        assert ((ball[..., 0] - ball[..., 1]) > 60).any()

    def test_starts_are_spread_over_the_distances(self, tiny: Path) -> None:
        task = make_task("tiny", "native")
        qpos, distance = task_pictures.spread(task, task.feasible_starts())
        every = np.linalg.norm(load_starts(tiny / "tiny.npz") - [0.2, 0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(qpos - [0.2, 0], axis=1), distance, atol=1e-5)
        np.testing.assert_allclose([(every < d).mean() for d in distance], (np.arange(6) + 0.5) / 6, atol=0.01)

    def test_without_opengl_it_says_so(self, tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
        def fail(*_):
            raise RenderError("no OpenGL context")

        monkeypatch.setattr(task_pictures, "open_scene", fail)
        assert run(task_pictures, monkeypatch, "tasks=tiny", f"results={tiny / 'pictures'}") == 0
        assert capsys.readouterr().out == "no pictures: no OpenGL context\n"

    def test_a_task_without_starts_is_still_in_its_goal_state(
        self, tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys
    ) -> None:
        (tiny / "tiny.npz").unlink()
        assert run(task_pictures, monkeypatch, "tasks=tiny", f"results={tiny / 'pictures'}") == 0
        said = capsys.readouterr().out
        if "no OpenGL context" in said:
            pytest.skip(said)
        assert "tiny: no picture of its starts" in said
        assert [path.name for path in (tiny / "pictures").iterdir()] == ["tasks.png"]


def test_raw_physics_takes_settings_like_every_command(tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(raw_physics, "compare", lambda model, qpos, **kw: {"native": 2.0 * len(qpos), "mjx": 1.0})
    run(raw_physics, monkeypatch, "task=tiny", "batch=5")
    assert "10 env-steps/s" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        run(raw_physics, monkeypatch, "--batch")
    assert stop.value.code == 2


def test_moving_picture_shows_the_shipped_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """One strip per policy, episodes one after the other: first under way (grey), framed by its outcome at its end."""
    out = tmp_path / "policies.gif"
    code = run(moving_picture, monkeypatch, f"out={out}", "width=64", "seconds=6")
    said = capsys.readouterr()
    if code:
        assert "no OpenGL context" in said.err
        pytest.skip(said.err)
    names = [name for name in TASKS if name in shipped_policies()]
    with Image.open(out) as picture:
        assert picture.size == (64 * len(names), 48)
        # Equal pictures in a row are one that stays longer.
        shown = sum(frame.info["duration"] for frame in ImageSequence.Iterator(picture))
        assert shown == pytest.approx(6_000, rel=0.05)
        frames = np.stack([np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(picture)])
    for i in range(len(names)):
        corner = frames[:, 1, 64 * i + 1]
        outcome = [np.abs(corner - colour).sum(axis=-1) < 60 for colour in (moving_picture.GREEN, moving_picture.RED)]
        assert not (outcome[0] | outcome[1])[0]
        assert (outcome[0] | outcome[1]).any()
        assert (np.abs(np.diff(frames[:, :, 64 * i : 64 * (i + 1)], axis=0)).sum(axis=(1, 2, 3)) > 0).mean() > 0.3
