"""A run that is killed, stopped and continued is bit-identical to one that was not; as a process of its own."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from rcg_jax.io.tables import read_csv
from rcg_jax.runs.checkpoint import iterations
from tests.real_run import end, metrics, start, state_digest, wait_for_rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "task", "batch"),
    [("native", "ring_peg", ["rollout.batch=episodes", "rollout.num_envs=4"]), ("mjx", "point_maze", [])],
)
def test_kill_and_stop_then_the_same_command_is_bit_identical(
    tmp_path: Path, engine: str, task: str, batch: list[str]
) -> None:
    settings = [f"engine={engine}", f"task={task}", "iterations=6", *batch]
    out = end(start(tmp_path / "whole", *settings))
    whole, folder = (tmp_path / name / task / "reverse" / "seed0" for name in ("whole", "parts"))
    assert ("engine=native is nearly twice as fast" in out) == (engine == "mjx")

    killed = start(tmp_path / "parts", *settings)
    wait_for_rows([killed], folder, 3)
    killed.kill()
    killed.communicate()
    if engine == "native":
        stopped = start(tmp_path / "parts", *settings)
        wait_for_rows([stopped], folder, len(metrics(folder)) + 1)
        stopped.send_signal(signal.SIGINT)
        out = end(stopped, 130)
        assert "resume with: python -m rcg_jax.run task=ring_peg" in out
        assert iterations(folder / "checkpoints")[-1] == len(metrics(folder)) < 6
    end(start(tmp_path / "parts", *settings))

    assert len(metrics(whole)) == 6
    assert metrics(folder) == metrics(whole)
    assert state_digest(folder) == state_digest(whole)
    assert read_csv(folder / "eval.csv") == read_csv(whole / "eval.csv")
