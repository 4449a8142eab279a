"""A run that is killed, stopped and continued is bit-identical to one that was not; as a process of its own."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from rcg_jax.io.tables import read_csv
from rcg_jax.runs.checkpoint import iterations
from tests.real_run import end, metrics, start, state_digest, wait_for_rows


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_kill_and_stop_then_the_same_command_is_bit_identical(tmp_path: Path, engine: str) -> None:
    # Segments on the one, whole episodes on the other.
    batch = ["rollout.batch=episodes", "rollout.num_envs=4"] if engine == "native" else []
    settings = [f"engine={engine}", "iterations=7", *batch]
    out = end(start(tmp_path / "whole", *settings))
    whole = tmp_path / "whole" / "ring_peg" / "reverse" / "seed0"
    assert ("engine=native is nearly twice as fast" in out) == (engine == "mjx")

    folder = tmp_path / "parts" / "ring_peg" / "reverse" / "seed0"
    killed = start(tmp_path / "parts", *settings)
    wait_for_rows(killed, folder, 3)
    killed.kill()
    killed.communicate()
    stopped = start(tmp_path / "parts", *settings)
    wait_for_rows(stopped, folder, len(metrics(folder)) + 1)
    stopped.send_signal(signal.SIGINT)
    out = end(stopped, 130)
    assert "resume with: python -m rcg_jax.run task=ring_peg" in out
    assert iterations(folder / "checkpoints")[-1] == len(metrics(folder)) < 7
    end(start(tmp_path / "parts", *settings))

    assert len(metrics(whole)) == 7
    assert metrics(folder) == metrics(whole)
    assert state_digest(folder) == state_digest(whole)
    assert read_csv(folder / "eval.csv") == read_csv(whole / "eval.csv")
