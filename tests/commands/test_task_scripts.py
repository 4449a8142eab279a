"""Pictures of the tasks and of the shipped policies, and raw physics, on a small task with known answers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.benchmarks import raw_physics
from experiments.paper import task_pictures


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


def test_raw_physics_takes_settings_like_every_command(tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(raw_physics, "compare", lambda model, qpos, **kw: {"native": 2.0 * len(qpos), "mjx": 1.0})
    run(raw_physics, monkeypatch, "task=tiny", "batch=5")
    assert "10 env-steps/s" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        run(raw_physics, monkeypatch, "--batch")
    assert stop.value.code == 2
