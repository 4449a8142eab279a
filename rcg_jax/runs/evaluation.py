"""Success on rho_0 of what a run, or a policy's file, has learned."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import mujoco
import numpy as np

import rcg_jax
from rcg_jax.config.settings import ConfigError
from rcg_jax.curriculum.feasible import make_compositions, to_rows
from rcg_jax.evaluate.regions import Cell, Region, make_regions, region_table
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.io.tables import write_atomically
from rcg_jax.physics.jit import jit
from rcg_jax.rl.episodes import Episodes
from rcg_jax.runs.load import LoadedRun, Trained


@dataclass(frozen=True)
class Outcomes:
    """Episodes of one policy, E of them.

    Attributes:
        success: (E,) bool.
        rate, low, high: success rate and its 95 % interval.
        mean_steps: steps to the goal of the successful episodes, on average; None without any.
    """

    success: np.ndarray
    rate: float
    low: float
    high: float
    mean_steps: float | None


@dataclass(frozen=True)
class RunEvaluation:
    """Success of a trained policy, stochastic (the paper's measure) and by its mean action, from the same starts."""

    stochastic: Outcomes
    mean: Outcomes
    regions: list[Region]
    starts_sha256: str


def _outcomes(episodes: Episodes) -> Outcomes:
    success, length = np.asarray(episodes.success), np.asarray(episodes.length)
    low, high = wilson_interval(int(success.sum()), len(success))
    steps = float(np.mean(length[success])) if success.any() else None
    return Outcomes(success, float(np.mean(success)), low, high, steps)


def evaluate_run(run: Trained, *, episodes: int, seed: int) -> RunEvaluation:
    """Evaluates a policy on rho_0, with so many episodes, stochastic and by its mean action.

    Raises:
        FileNotFoundError: the task has no feasible starts.
        StartsFileError: their file is damaged.
    """
    task = run.task
    sha256 = task.starts_sha256()
    evaluate = jit(make_evaluate(run.pi, task, episodes), fusion_emitters=task.engine.fusion_emitters)
    result = jax.device_get(evaluate(run.actor, jax.random.key(seed)))
    subsets, distance = make_compositions(task)(to_rows(task.feasible_starts())[result.start])
    stochastic, mean = _outcomes(result.stochastic), _outcomes(result.mean)
    return RunEvaluation(stochastic, mean, make_regions(distance, subsets, stochastic.success, mean.success), sha256)


def table(result: RunEvaluation) -> str:
    """The evaluation as text: success with its interval, steps to the goal, success by region of the start."""
    lines = [f"{'policy':<12}{'success':>9}  {'95 % interval':<15}{'steps to goal':>14}"]
    for name, one in (("stochastic", result.stochastic), ("mean", result.mean)):
        steps = "-" if one.mean_steps is None else f"{one.mean_steps:.0f}"
        lines.append(f"{name:<12}{one.rate:>9.3f}  {f'[{one.low:.3f}, {one.high:.3f}]':<15}{steps:>14}")
    return "\n".join([*lines, "", region_table(result.regions)])


def row(run: LoadedRun, result: RunEvaluation, *, command: str, episodes: int, seed: int) -> dict[str, Cell]:
    """A row of evaluation.csv.

    ``success_by_distance`` lists the bins of the starts' distance, separated by spaces, each as
    ``lower end [m]:episodes:successes of the stochastic policy:of the mean policy``.
    """
    stochastic, mean = result.stochastic, result.mean
    return {
        "command": command,
        "engine": run.task.engine.name,
        "episodes": episodes,
        "seed": seed,
        "iteration": run.iteration,
        "env_steps": run.env_steps,
        "success_stochastic": stochastic.rate,
        "success_stochastic_low": stochastic.low,
        "success_stochastic_high": stochastic.high,
        "success_mean": mean.rate,
        "success_mean_low": mean.low,
        "success_mean_high": mean.high,
        "steps_to_goal_stochastic": stochastic.mean_steps,
        "steps_to_goal_mean": mean.mean_steps,
        "success_by_distance": " ".join(
            f"{one.name.partition('-')[0]}:{one.episodes}:{one.successes_stochastic}:{one.successes_mean}"
            for one in result.regions
            if one.kind == "distance"
        ),
        "starts_sha256": result.starts_sha256,
        "rcg_jax": rcg_jax.__version__,
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "backend": jax.default_backend(),
    }


def check_columns(path: Path, columns: Sequence[str]) -> str:
    """The content of a CSV file, which may be absent, with these columns."""
    try:
        old = path.read_text() if path.exists() else ""
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    header = next(csv.reader(io.StringIO(old)), None)
    if header is not None and header != list(columns):
        raise ConfigError(f"{path}: it has other columns, from another version; move it away")
    return old


def append_rows(path: Path, rows: Sequence[Mapping[str, Cell]]) -> None:
    """Adds rows, at least one, to a CSV file, or makes it, so that a kill leaves the old or the new file.

    Raises:
        ConfigError: the file has other columns, or cannot be written.
    """
    try:
        old = check_columns(path, list(rows[0]))
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        if not old:
            writer.writeheader()
        for cells in rows:
            writer.writerow({name: f"{x:.9g}" if isinstance(x, float) else x for name, x in cells.items()})
        write_atomically(path, (old + text.getvalue()).encode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
