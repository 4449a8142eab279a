"""Evaluating a saved run on rho_0: the command behind ``python -m rcg_jax.evaluate``."""

from __future__ import annotations

import csv
import io
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import mujoco
import numpy as np

import rcg_jax
from rcg_jax.arguments import run_command
from rcg_jax.bins import bin_width
from rcg_jax.config import ConfigError, option
from rcg_jax.evaluate import make_evaluate, wilson_interval
from rcg_jax.load import LoadedRun, load_run
from rcg_jax.metrics import write_atomically
from rcg_jax.names import ENGINES
from rcg_jax.physics.compile import enable_compilation_cache, jit
from rcg_jax.rl.episodes import Episodes
from rcg_jax.starts_file import StartsFileError, starts_hash

#: Width of the bins of the starts' distance to the goal [m], at least.
BIN = 0.1

#: A cell of evaluation.csv; None leaves it empty.
Cell = str | int | float | None


@dataclass(frozen=True)
class EvaluateOptions:
    """Settings of ``python -m rcg_jax.evaluate``."""

    run: str = option("", "folder of a seed: <run_dir>/<task>/<method>/seed<k>")
    engine: str = option("", "physics; default: the one that the run was trained with", choices=ENGINES)
    episodes: int = option(2_000, "episodes of each policy", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    iteration: str = option("newest", "checkpoint: newest, or a number of iterations")


@dataclass(frozen=True)
class Outcomes:
    """Episodes of one policy, E of them.

    Attributes:
        success: (E,) bool.
        length: (E,) steps until the goal, a failure, or the horizon.
        distance: (E,) distance of each episode's start to the goal [m].
    """

    success: np.ndarray
    length: np.ndarray
    distance: np.ndarray

    @property
    def rate(self) -> float:
        """Success rate."""
        return float(np.mean(self.success))

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval of the success rate."""
        return wilson_interval(int(np.sum(self.success)), len(self.success))

    @property
    def mean_steps(self) -> float | None:
        """Mean steps to the goal of the successful episodes; None without any."""
        return float(np.mean(self.length[self.success])) if self.success.any() else None

    @property
    def bin_width(self) -> float:
        """Width of the bins of :meth:`by_distance` [m]."""
        return bin_width(float(self.distance.max()), BIN)

    def by_distance(self) -> Iterator[tuple[float, int, int]]:
        """(lower end of the bin [m], successes, episodes) of each bin of the start's distance that is not empty."""
        bins = np.floor(self.distance / self.bin_width + 1e-6).astype(int)
        for one in np.unique(bins):
            inside = bins == one
            yield one * self.bin_width, int(np.sum(self.success[inside])), int(np.sum(inside))


@dataclass(frozen=True)
class RunEvaluation:
    """Success of a run's policy on rho_0.

    Attributes:
        stochastic: outcomes of the stochastic policy, the paper's measure.
        mean: outcomes of the policy's mean action, from the same starts.
        starts_sha256: hash of the set of feasible starts.
    """

    stochastic: Outcomes
    mean: Outcomes
    starts_sha256: str


def evaluate_run(run: LoadedRun, *, episodes: int, seed: int) -> RunEvaluation:
    """Evaluates a run's policy on its task.

    Args:
        run: the run, with its task on the engine to evaluate on.
        episodes: E episodes of each policy.
        seed: of the starts and of the action noise.

    Raises:
        FileNotFoundError: the task has no feasible starts.
        StartsFileError: their file is damaged.
    """
    task = run.task
    sha256 = starts_hash(task.feasible_file)
    evaluate = jit(make_evaluate(run.config, task, episodes), fusion_emitters=task.engine.fusion_emitters)
    result = jax.device_get(evaluate(run.state, jax.random.key(seed)))
    starts = task.feasible_starts().take(result.start)
    distance = np.asarray(jit(lambda s: jax.vmap(task.distance)(task.snapshot(task.reset(s))))(starts))

    def outcomes(one: Episodes) -> Outcomes:
        return Outcomes(success=np.asarray(one.success), length=np.asarray(one.length), distance=distance)

    return RunEvaluation(outcomes(result.stochastic), outcomes(result.mean), sha256)


def table(result: RunEvaluation) -> str:
    """The evaluation as text: success with its interval, steps to the goal, success by distance of the start."""
    lines = [f"{'policy':<12}{'success':>9}  {'95 % interval':<15}{'steps to goal':>14}"]
    for name, one in (("stochastic", result.stochastic), ("mean", result.mean)):
        low, high = one.interval
        steps = "-" if one.mean_steps is None else f"{one.mean_steps:.0f}"
        lines.append(f"{name:<12}{one.rate:>9.3f}  {f'[{low:.3f}, {high:.3f}]':<15}{steps:>14}")
    lines += ["", f"{'distance':<14}{'episodes':>10}{'stochastic':>12}{'mean':>9}"]
    width = result.stochastic.bin_width
    for (low, good, number), (_, good_mean, _) in zip(
        result.stochastic.by_distance(), result.mean.by_distance(), strict=True
    ):
        lines.append(
            f"{f'{low:.1f}-{low + width:.1f} m':<14}{number:>10}{good / number:>12.3f}{good_mean / number:>9.3f}"
        )
    return "\n".join(lines)


def row(run: LoadedRun, result: RunEvaluation, *, command: str, episodes: int, seed: int) -> dict[str, Cell]:
    """A row of evaluation.csv.

    ``success_by_distance`` lists the bins of the starts' distance, separated by spaces, each as
    ``lower end [m]:episodes:successes of the stochastic policy:of the mean policy``.
    """
    stochastic, mean = result.stochastic, result.mean
    bins = zip(stochastic.by_distance(), mean.by_distance(), strict=True)
    return {
        "command": command,
        "engine": run.task.engine.name,
        "episodes": episodes,
        "seed": seed,
        "iteration": run.iteration,
        "env_steps": run.env_steps,
        "success_stochastic": stochastic.rate,
        "success_stochastic_low": stochastic.interval[0],
        "success_stochastic_high": stochastic.interval[1],
        "success_mean": mean.rate,
        "success_mean_low": mean.interval[0],
        "success_mean_high": mean.interval[1],
        "steps_to_goal_stochastic": stochastic.mean_steps,
        "steps_to_goal_mean": mean.mean_steps,
        "success_by_distance": " ".join(
            f"{low:.1f}:{n}:{good}:{good_mean}" for (low, good, n), (_, good_mean, _) in bins
        ),
        "starts_sha256": result.starts_sha256,
        "rcg_jax": rcg_jax.__version__,
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "backend": jax.default_backend(),
    }


def append_row(path: Path, cells: dict[str, Cell]) -> None:
    """Adds a row to a CSV file (made if it does not exist), so that a kill leaves the old or the new file.

    Raises:
        ConfigError: the file has other columns, or cannot be written.
    """
    try:
        old = path.read_text() if path.exists() else ""
        header = next(csv.reader(io.StringIO(old)), None)
        if header is not None and header != list(cells):
            raise ConfigError(f"{path}: it has other columns, from another version; move it away")
        text = io.StringIO()
        writer = csv.DictWriter(text, list(cells), lineterminator="\n")
        if header is None:
            writer.writeheader()
        writer.writerow({name: f"{x:.9g}" if isinstance(x, float) else x for name, x in cells.items()})
        write_atomically(path, (old + text.getvalue()).encode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None


def _evaluate(options: EvaluateOptions, argv: Sequence[str]) -> None:
    if options.iteration != "newest" and not options.iteration.isdecimal():
        raise ConfigError(f"iteration={options.iteration}: must be newest or a number >= 1")
    iteration = None if options.iteration == "newest" else int(options.iteration)
    enable_compilation_cache()
    run = load_run(Path(options.run), engine=options.engine or None, iteration=iteration)
    for damage in run.damaged:
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    name = f"{run.path}, iteration {run.iteration} ({run.env_steps:,} steps), engine {run.task.engine.name}"
    print(f"{name}: {options.episodes} episodes of each policy ...", flush=True)
    begin = time.monotonic()
    try:
        result = evaluate_run(run, episodes=options.episodes, seed=options.seed)
    except (FileNotFoundError, StartsFileError) as error:
        raise ConfigError(str(error)) from None
    print(f"\n{table(result)}\n")
    path = run.path / "evaluation.csv"
    command = shlex.join(["python", "-m", "rcg_jax.evaluate", *argv])
    append_row(path, row(run, result, command=command, episodes=options.episodes, seed=options.seed))
    print(f"feasible starts sha256 {result.starts_sha256[:16]}; {time.monotonic() - begin:.0f} s; added to {path}")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    words = sys.argv[1:] if argv is None else argv
    return run_command(EvaluateOptions, "rcg_jax.evaluate", words, lambda options: _evaluate(options, words))
