"""What ``rcg_jax.open_run``, ``open_policy`` and ``train`` give, and refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rcg_jax
from rcg_jax.config.settings import ConfigError
from rcg_jax.policies.policy_file import PolicyFileError
from rcg_jax.runs import program
from tests import fake_run


def test_training_gives_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "load_program", fake_run.load)
    run = rcg_jax.train("task=point_maze", "seed=3", "iterations=4", "eval_every=2", "write_report=false")
    assert run.path == Path("runs/point_maze/reverse/seed3")
    assert run.config.seed == 3
    np.testing.assert_array_equal(run.metrics["iteration"], [1, 2, 3, 4])
    np.testing.assert_array_equal(run.evaluations["iteration"], [2, 4])
    assert [one.iteration for one in run.starts] == [1, 2, 3, 4]
    assert len(rcg_jax.open_run(run.path).metrics["iteration"]) == 4


def test_what_fails_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "load_program", fake_run.load)
    with pytest.raises(ConfigError, match="unknown field iteration;"):
        rcg_jax.train("iteration=4")
    with pytest.raises(ConfigError, match="num_seeds=2: train gives one run"):
        rcg_jax.train("num_seeds=2")
    rcg_jax.train("task=point_maze", "iterations=1", "write_report=false")
    with pytest.raises(ConfigError, match="r_min"):
        rcg_jax.train("task=point_maze", "iterations=1", "curriculum.r_min=0.2")
    with pytest.raises(ConfigError, match=r"no config\.yaml there"):
        rcg_jax.open_run("nowhere")
    with pytest.raises(PolicyFileError, match="must be the name of a shipped policy"):
        rcg_jax.open_policy("nothing")


@pytest.mark.slow
def test_a_run_shows_what_it_learned(run: Path, gl: None) -> None:
    opened = rcg_jax.open_run(run)
    table = opened.evaluate(episodes=20)
    assert len(table.result.stochastic.success) == 20
    assert "stochastic" in repr(table)
    assert [len(one.qpos) == len(one.distance) for one in opened.episodes(5)] == [True] * 5
    videos = opened.video(1)
    assert videos._repr_html_().count("data:video/mp4;base64,") in (1, 2)
    assert "videos>" in repr(videos)
    for refused in (lambda: opened.evaluate(episodes=0), lambda: opened.episodes(0)):
        with pytest.raises(ValueError, match="must be at least 1"):
            refused()
