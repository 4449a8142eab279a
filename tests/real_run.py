"""Small real runs from the command line, in this process and as processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

from rcg_jax import run
from rcg_jax.io.tables import read_csv
from rcg_jax.runs.checkpoint import iterations

ROOT = Path(__file__).parents[1]

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


def train(run_dir: Path, *args: str) -> None:
    """The command line in this process."""
    assert run.main([*TINY, f"run_dir='{run_dir}'", *args]) == 0


def start(run_dir: Path, *args: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "rcg_jax.run", *TINY, f"run_dir='{run_dir}'", *args]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def end(process: subprocess.Popen[str], code: int = 0) -> str:
    out, err = process.communicate(timeout=900)
    assert process.returncode == code, err
    return out


def wait_for_rows(processes: list[subprocess.Popen[str]], folder: Path, count: int) -> None:
    """Until a run has finished so many iterations."""
    deadline = time.monotonic() + 900
    while len(read_csv(folder / "metrics.csv")[1]) < count:
        assert all(process.poll() is None for process in processes), [each.communicate() for each in processes]
        assert time.monotonic() < deadline, "the run does not get on"
        time.sleep(0.01)


def metrics(folder: Path) -> list[list[str]]:
    """Rows without the columns that depend on the machine."""
    header, rows = read_csv(folder / "metrics.csv")
    assert header[-2:] == ["wall_s", "steps_per_s"]
    return [row[:-2] for row in rows]


def state_digest(folder: Path) -> str:
    newest = iterations(folder / "checkpoints")[-1]
    return json.loads((folder / "checkpoints" / str(newest) / "manifest.json").read_text())["body"]["array_sha256"]
