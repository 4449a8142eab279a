"""What a trainer leaves behind while it trains, and the one evaluator that scores it afterwards.

A snapshot is a policy with the seconds since its command was started and the physics steps simulated until then.
Scoring comes after the race, so it costs no trainer any time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rcg_jax.gymnasium import TaskVectorEnv

#: Observations (B, obs_dim), whether to act by the mean -> actions (B, nu).
Predict = Callable[[np.ndarray, bool], np.ndarray]

#: Environment variable with the time at which the command was started [s since the epoch].
STARTED = "RACE_STARTED"


@dataclass(frozen=True)
class Snapshot:
    """A saved policy: ``path`` is a file or folder whose name starts with ``<seconds>_<env_steps>``."""

    path: Path
    seconds: float
    env_steps: int


def elapsed() -> float:
    """Seconds since the command of this process was started."""
    return time.time() - float(os.environ[STARTED])


def name(seconds: float, env_steps: int) -> str:
    """Name of a snapshot without suffix."""
    return f"{seconds:08.1f}_{env_steps}"


def snapshots(folder: Path) -> Iterator[Snapshot]:
    """The snapshots in ``folder``, oldest first."""
    for path in sorted(folder.iterdir()):
        seconds, _, steps = path.name.removesuffix(path.suffix if path.is_file() else "").partition("_")
        yield Snapshot(path, float(seconds), int(steps))


def success(env: TaskVectorEnv, predict: Predict, qpos: np.ndarray, *, mean: bool) -> float:
    """Share of one episode from each of the starts ``qpos`` (B, nq) that reaches the goal within T."""
    obs, _ = env.reset(seed=0, options={"qpos": qpos})
    running, solved = np.ones(len(qpos), bool), np.zeros(len(qpos), bool)
    while running.any():
        obs, _, terminated, truncated, infos = env.step(predict(obs, mean))
        solved |= running & infos["success"]
        running &= ~(terminated | truncated)
    return float(solved.mean())
