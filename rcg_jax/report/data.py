"""What a run's files say, as numbers and words for the page. Nothing here loads the task."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rcg_jax.config.class_path import class_name
from rcg_jax.config.compose import show
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.io.tables import read_columns
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.settings import is_free, read_config
from rcg_jax.tasks import task_class
from rcg_jax.tasks.training import resolve

#: Points of a curve, at most; of longer runs evenly chosen iterations, which carry the mean of their neighbours.
MOST_POINTS = 1_000

#: (column, title, unit) of the small curves; a run shows those that it has, and after them its method's own.
SMALL_CURVES = (
    ("start_distance", "mean distance of the starts to the goal", "m"),
    ("steps_per_s", "speed", "env steps/s"),
    ("labelled", "share of the starts with a label", ""),
    ("replay_size", "starts in the replay", ""),
    ("brownian_horizon", "length of a Brownian walk, T_B", "steps"),
    ("alice_steps", "Alice's mean episode", "steps"),
    ("alice_reward", "Alice's mean reward", "steps"),
    ("alice_spread", "spread of Alice's proposals", "rad, m"),
    ("kl", "mean KL of a TRPO step", "nats"),
    ("value_error", "error of the value function", ""),
)

#: Columns that other parts of the page show, or that say little as a curve.
_SHOWN = {
    *("iteration", "env_steps", "success", "episodes", "share_low", "share_good", "share_high", "wall_s"),
    *("proposal_steps", "surrogate_gain", "line_search_attempts", "accepted", "policy_std", "nonfinite"),
}


@dataclass(frozen=True)
class RunData:
    """A run's settings and numbers.

    Attributes:
        path: the seed's folder.
        config: its settings.
        metrics: columns of metrics.csv.
        evaluations: columns of eval.csv; may be empty.
        damage: what is wrong with the files, each in one line.
    """

    path: Path
    config: Config
    metrics: dict[str, np.ndarray]
    evaluations: dict[str, np.ndarray]
    damage: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Task, method and seed, in words."""
        return f"{self.task}, {self.method}, seed {self.config.seed}"

    @property
    def task(self) -> str:
        """The task's name, or the class's."""
        return class_name(self.config.task)

    @property
    def method(self) -> str:
        """The method's name, or the class's."""
        return class_name(self.config.method)

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return int(self.metrics["iteration"][-1])

    @property
    def wall_s(self) -> float:
        """Seconds of training."""
        return float(self.metrics["wall_s"][-1])


def read_run(path: Path) -> RunData:
    """Reads the files of a seed's folder ``<run_dir>/<task>/<method>/seed<k>``.

    Raises:
        ConfigError: no run there, no finished iteration, or nothing in its metrics.csv can be read.
    """
    config = read_config(path)
    file = path / "metrics.csv"
    metrics = read_columns(file)
    evaluations = read_columns(path / "eval.csv")
    evaluations = evaluations if "success_stochastic_high" in evaluations else {}
    if not {"iteration", "env_steps", "success", "wall_s", "steps_per_s"} <= set(metrics):
        if evaluations:
            raise ConfigError(f"run={path}: {file.name} is damaged: eval.csv has evaluations, it has no iteration")
        raise ConfigError(f"run={path}: it has no finished iteration yet")
    # What a run that was killed at any moment does not leave behind.
    done, damage = metrics["iteration"].astype(int), ""
    jumps = np.flatnonzero(np.diff(done) != 1)
    if evaluations and evaluations["iteration"][-1] > done[-1] + 1:
        damage = f"it ends at iteration {done[-1]}, eval.csv at iteration {int(evaluations['iteration'][-1])}"
    elif len(jumps):
        damage = f"after iteration {done[jumps[0]]} rows are missing or not in order"
    return RunData(path, config, metrics, evaluations, (f"{file} is damaged: {damage}",) if damage else ())


def duration(seconds: float) -> str:
    """A time in words: 45 s, 3.4 min, 2.1 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def large(number: float) -> str:
    """A number of steps in words: 950, 50 k, 2.5 M."""
    for unit, name in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= unit:
            return f"{number / unit:.3g}{name}"
    return f"{number:.0f}"


def percent(share: float) -> str:
    """A share in percent with one decimal at most: 62.5 %, 60 %. Only none and all are 0 % and 100 %."""
    text = f"{100 * share:.1f}".removesuffix(".0")
    if text == "100" and share < 1:
        return "> 99.9 %"
    return "< 0.1 %" if text == "0" and share > 0 else f"{text} %"


def headline(run: RunData) -> tuple[str, str]:
    """The result in one sentence, and what belongs to it in a second."""
    trained = f"{large(run.metrics['env_steps'][-1])} steps, in {duration(run.wall_s)}"
    if not run.evaluations:
        share = percent(float(run.metrics["success"][-1]))
        detail = f"{share} of the training episodes of iteration {run.iterations} reached the goal."
        return f"Not evaluated yet after {trained}", detail
    final = {name: float(column[-1]) for name, column in run.evaluations.items()}
    rate, episodes = final["success_stochastic"], int(final["episodes"])
    reached = f"{percent(rate)} of the starts ({round(rate * episodes):,} of {episodes:,}) reach the goal"
    took = float(np.interp(final["iteration"], run.metrics["iteration"], run.metrics["wall_s"]))
    sentence = f"{reached} after {large(final['env_steps'])} steps, in {duration(took)}"
    # The best evaluation, where the last one is significantly worse: their 95 % intervals are disjoint.
    rates, low = run.evaluations["success_stochastic"], run.evaluations["success_stochastic_low"]
    better = np.where(low > final["success_stochastic_high"], rates, -1)
    best = int(np.argmax(better))
    if better[best] >= 0:
        sentence += f"; best: {percent(rates[best])} after {large(run.evaluations['env_steps'][best])} steps"
    detail = (
        f"95 % interval {final['success_stochastic_low']:.3f} to {final['success_stochastic_high']:.3f}, with the "
        f"stochastic policy; with the policy's mean action {final['success_mean']:.3f}."
    )
    if final["iteration"] < run.iterations:
        detail += f" The run is now at iteration {run.iterations} of {run.config.iterations}, {trained}."
    return sentence, detail


def settings(config: Config) -> dict[str, list[dict[str, Any]]]:
    """Every setting: those that differ from their defaults, and the rest. Values are text.

    ``told``: it is part of what was computed, or for how long.
    """
    plain = Config(task=config.task)
    with contextlib.suppress(ConfigError):  # its class cannot be found any more
        plain = with_sizes(resolve(plain, ())[0], task_class(config.task).horizon)
    defaults = {name: value for name, _, value in flatten(plain)} | {"task": Config().task}
    groups: dict[str, list[dict[str, Any]]] = {"changed": [], "rest": []}
    for name, item, value in flatten(config):
        groups["rest" if value == defaults[name] else "changed"].append(
            {
                "name": name,
                "value": show(value),
                "default": show(defaults[name]),
                "help": item.metadata["help"] + (f" [{item.metadata['unit']}]" if item.metadata["unit"] else ""),
                "told": name == "iterations" or not is_free(name),
            }
        )
    return groups


def curves(run: RunData) -> dict[str, Any]:
    """The curves of one run: columns of numbers by name, None for a gap."""
    length = len(run.metrics["iteration"])
    first = thinned(length)
    counts = np.diff(np.append(first, length))
    means = {name: numbers(np.add.reduceat(column, first) / counts) for name, column in run.metrics.items()}
    return {"metrics": means, "evaluations": {name: numbers(column) for name, column in run.evaluations.items()}}


def small_curves(columns: Sequence[str]) -> list[dict[str, str]]:
    """Name, title and unit of the small curves of a run with these columns."""
    known = {name for name, _, _ in SMALL_CURVES}
    own = [(name, name.replace("_", " "), "") for name in columns if name not in known | _SHOWN]
    return [
        {"name": name, "title": title, "unit": unit} for name, title, unit in [*SMALL_CURVES, *own] if name in columns
    ]


def thinned(length: int) -> np.ndarray:
    """First rows of at most :data:`MOST_POINTS` groups of neighbouring rows."""
    return np.unique(np.linspace(0, length, min(MOST_POINTS, length), endpoint=False).astype(int))


def numbers(column: np.ndarray) -> list[float | None]:
    """For JSON: seven digits, None for what is not finite."""
    return [float(f"{x:.7g}") if np.isfinite(x) else None for x in column.tolist()]
