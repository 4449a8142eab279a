"""Whole runs of ring_peg with both engines, from the command line: killed, stopped, resumed, several seeds at once."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rcg_jax.io.tables import read_csv
from rcg_jax.runs.checkpoint import iterations

ROOT = Path(__file__).parents[2]

#: As little work per iteration as the algorithm allows: 20 environments, one whole episode each.
TINY = [
    "task=ring_peg",
    "rollout.num_envs=20",
    "rollout.batch_size=2000",
    "baseline.minibatch_size=500",
    "curriculum.num_new=20",
    "curriculum.num_old=10",
    "curriculum.num_candidates=200",
    "curriculum.replay_capacity=100",
    "checkpoint_every=2",
    "eval_every=3",
    "write_report=false",
    "evaluation.episodes=10",
    "evaluation.final_episodes=10",
]


def start(run_dir: Path, *args: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "rcg_jax.run", *TINY, f"run_dir='{run_dir}'", *args]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def end(process: subprocess.Popen[str], code: int = 0) -> str:
    out, err = process.communicate(timeout=900)
    assert process.returncode == code, err
    return out


def wait_for_rows(process: subprocess.Popen[str], folder: Path, count: int) -> None:
    deadline = time.monotonic() + 900
    while len(read_csv(folder / "metrics.csv")[1]) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def metrics(folder: Path) -> list[list[str]]:
    return [row[:-2] for row in read_csv(folder / "metrics.csv")[1]]


def state_digest(folder: Path) -> str:
    newest = iterations(folder / "checkpoints")[-1]
    return json.loads((folder / "checkpoints" / str(newest) / "manifest.json").read_text())["body"]["array_sha256"]


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


@pytest.mark.slow
def test_seeds_together_equal_each_alone_and_go_on_alone(tmp_path: Path) -> None:
    # One policy update: after more, rounding has grown through contacts into other trajectories.
    settings = ["engine=native", "iterations=1", "trpo.iterations=1", "rollout.batch_size=10000"]
    end(start(tmp_path / "both", *settings, "num_seeds=2", "seed=5"))
    both = tmp_path / "both" / "ring_peg" / "reverse"
    for seed in (5, 6):
        end(start(tmp_path / "alone", *settings, f"seed={seed}"))
        alone = tmp_path / "alone" / "ring_peg" / "reverse" / f"seed{seed}"
        names = {path.name for path in alone.iterdir()}
        assert {"config.yaml", "metrics.csv", "eval.csv", "tensorboard", "checkpoints"} <= names
        assert {path.name for path in (both / f"seed{seed}").iterdir()} == names
        one, other = read_csv(alone / "metrics.csv"), read_csv(both / f"seed{seed}" / "metrics.csv")
        assert one[0] == other[0]
        values = [[float(cell) for cell in rows[0][:-2]] for rows in (one[1], other[1])]
        np.testing.assert_allclose(values[1], values[0], rtol=1e-2, atol=1e-4)
    # Different seeds are different runs.
    assert metrics(both / "seed5") != metrics(both / "seed6")
    end(start(tmp_path / "both", *settings, "iterations=2", "seed=6"))
    assert [row[0] for row in metrics(both / "seed6")] == ["1", "2"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["oracle", "self_play"])
def test_other_methods_resume_bit_for_bit(tmp_path: Path, method: str) -> None:
    settings = ["task=point_maze", f"method={method}", "engine=native", "oracle.num_points=20", "oracle.max_rounds=2"]
    end(start(tmp_path / "whole", *settings, "iterations=3"))
    end(start(tmp_path / "parts", *settings, "iterations=1"))
    end(start(tmp_path / "parts", *settings, "iterations=3"))
    whole, parts = (tmp_path / name / "point_maze" / method / "seed0" for name in ("whole", "parts"))
    assert len(metrics(whole)) == 3
    assert metrics(parts) == metrics(whole)
    assert state_digest(parts) == state_digest(whole)
