"""A saved run of the tiny task with all that a report tells, and known numbers."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rcg_jax.io.starts_file import starts_hash
from rcg_jax.io.tables import Value
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.recorder import Evaluation, Recorder
from rcg_jax.runs.start_record import start_row
from rcg_jax.types import StartLabels, StartSet
from tests import tiny_run

ITERATIONS = 6

#: Starts of iteration i lie this far from the goal, which is at (0.2, 0) [m].
RADIUS = {i: 0.05 * i for i in range(1, ITERATIONS + 1)}


def starts(iteration: int) -> tuple[StartSet, StartLabels]:
    """Twenty starts around the goal and two that are not valid; 4 too hard, 5 good, 8 mastered, 3 unknown."""
    angle = 2 * np.pi * np.arange(22) / 20
    qpos = np.stack([0.2 + RADIUS[iteration] * np.cos(angle), RADIUS[iteration] * np.sin(angle)], axis=1)
    successes = np.array([0] * 4 + [2] * 5 + [4] * 8 + [1] * 3 + [4] * 2)
    episodes = np.array([4] * 17 + [1] * 3 + [4] * 2)
    return (
        StartSet(qpos=qpos, qvel=np.zeros((22, 2)), valid=np.arange(22) < 20),  # type: ignore[arg-type]
        StartLabels(successes=successes, episodes=episodes, steps=successes),  # type: ignore[arg-type]
    )


def metrics(iteration: int) -> dict[str, Value]:
    return {
        "iteration": iteration,
        "env_steps": 2000 * iteration,
        "success": 0.1 * iteration,
        "start_distance": RADIUS[iteration],
        "share_low": 4 / 17,
        "share_good": 5 / 17,
        "share_high": 8 / 17,
        "own_number": 3.0 * iteration,
        "wall_s": 30.0 * iteration,
        "steps_per_s": 2000 / 30,
    }


def save_run(run_dir: Path, *, seed: int | None = None, method: str = "reverse") -> Path:
    """Writes the run; returns its folder. Evaluations come every two iterations: 20, 40 and 60 of 100 episodes.

    With a seed it has no checkpoint, and that many more successes in each evaluation.
    """
    if seed is None:
        tiny_run.save_run(run_dir, iterations=(ITERATIONS,))
    config = dataclasses.replace(tiny_run.config(run_dir), method=method, iterations=ITERATIONS)
    seed = seed or 0
    folder = RunFolder(config, seed)
    folder.open()
    folder.write_config()
    recorder = Recorder(folder, list(metrics(1))[:-2], start=0, warn=print)
    for i in range(1, ITERATIONS + 1):
        recorder.add_metrics(metrics(i))
        recorder.add_starts(start_row(i, *starts(i)))
        if i % 2 == 0:
            evaluation = Evaluation(i, 2000 * i, 10 * i + seed, 5 * i, 100, starts_hash(tiny_run.Tiny.feasible_file))
            recorder.add_evaluation(evaluation)
    rows = [(ITERATIONS, k, int(k < 60), 20, int(k < 30), 25) for k in range(100)]
    recorder.write_outcomes(rows)
    folder.close()
    return folder.path


def far_starts(number: int) -> tuple[StartSet, StartLabels]:
    """Starts at infinity, as a broken simulation would leave them, and as many of their labels."""
    return (
        StartSet.at_rest(jnp.full((number, 2), 1e9), 2),
        StartLabels.none(number),
    )


def content(path: Path) -> dict[str, Any]:
    """The data in a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.DOTALL)
    assert found
    return json.loads(found.group(1))
