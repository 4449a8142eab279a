"""Pictures of the tasks and of the shipped policies, and raw physics, on a small task with known answers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from PIL import Image, ImageSequence

from experiments.benchmarks import raw_physics
from experiments.paper import moving_picture, task_pictures
from rcg_jax.io.starts_file import load_starts
from rcg_jax.policies.policy_file import shipped_policies
from rcg_jax.report.scene import RenderError
from rcg_jax.tasks import TASKS, make_task


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    tiny_run.register(tmp_path, monkeypatch)
    return tmp_path


def run(module, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", [module.__name__, *words])
    return module.main()


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
