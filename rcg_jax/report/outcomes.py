"""Success of the final policy by where an episode began."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rcg_jax.evaluate.perturb import PERTURBATIONS, ROBUSTNESS_COLUMNS
from rcg_jax.evaluate.regions import make_regions
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.io.tables import read_columns, read_csv
from rcg_jax.physics.jit import jit
from rcg_jax.report.points import Places
from rcg_jax.runs.load import LoadedRun
from rcg_jax.runs.recorder import OUTCOME_COLUMNS
from rcg_jax.runs.seeds import evaluation_key

#: Bins of the distance to the goal, at most.
MOST_BINS = 12


@dataclass(frozen=True)
class Outcomes:
    """The episodes of the last evaluation, E of each policy.

    Attributes:
        iteration: of the policy.
        qpos: (E, nq) where they began.
        stochastic: (E,) bool, the stochastic policy reached the goal.
        steps: (E,) until then, or until the end.
        mean: (E,) bool, the policy's mean action reached it.
    """

    iteration: int
    qpos: np.ndarray
    stochastic: np.ndarray
    steps: np.ndarray
    mean: np.ndarray


def final_outcomes(run: LoadedRun, feasible: np.ndarray) -> Outcomes:
    """The episodes of a run's last evaluation, from some of its feasible starts (K, nq).

    Where the run has not kept those of this policy and these starts, they are made again, from the same keys.
    """
    kept = read_columns(run.path / "final_evaluation.csv")
    header, rows = read_csv(run.path / "eval.csv")
    sha256 = dict(zip(header, rows[-1])).get("starts_sha256") if rows else None
    complete = set(kept) == set(OUTCOME_COLUMNS) and sha256 == run.task.starts_sha256()
    if complete and kept["iteration"][0] == run.iteration:
        start, stochastic, steps, mean = (kept[name].astype(int) for name in OUTCOME_COLUMNS[1:5])
    else:
        evaluate = make_evaluate(run.pi, run.task, run.config.evaluation.episodes)
        compiled = jit(evaluate, fusion_emitters=run.task.engine.fusion_emitters)
        result = jax.device_get(compiled(run.actor, evaluation_key(run.config.seed, run.iteration)))
        start, stochastic, steps = result.start, result.stochastic.success, result.stochastic.length
        mean = result.mean.success
    return Outcomes(run.iteration, feasible[start], stochastic.astype(bool), steps, mean.astype(bool))


def success(outcomes: Outcomes, places: Places, names: Mapping[str, str]) -> dict[str, Any]:
    """What the page shows: success in all, by the start's distance to the goal, and by the task's named regions.

    ``places`` are where the episodes began, ``names`` what regions are called where their own name does not do.
    """
    rows: dict[str, list[dict[str, Any]]] = {"all": [], "distance": [], "composition": []}
    for one in make_regions(places.distance, places.regions, outcomes.stochastic, outcomes.mean, bins=MOST_BINS):
        if one.name == "not at_goal":
            continue  # nearly all starts
        whole = one.name.removeprefix("not ")
        words = names.get(whole, whole.replace("_", " "))
        label = words if whole == one.name else f"not {words}"
        low, high = wilson_interval(one.successes_stochastic, one.episodes)
        rows[one.kind].append(
            {
                "label": f"{one.name.replace('-', '–')} m" if one.kind == "distance" else label,
                "successes": one.successes_stochastic,
                "episodes": one.episodes,
                "rate": one.successes_stochastic / one.episodes,
                "mean": one.successes_mean / one.episodes,
                "low": low,
                "high": high,
            }
        )
    reached = outcomes.steps[outcomes.stochastic]
    return {
        "iteration": outcomes.iteration,
        "all": rows["all"][0],
        "distance": rows["distance"],
        "region": rows["composition"],
        "steps": float(np.mean(reached)) if len(reached) else None,
    }


def robustness(run: Path) -> list[dict[str, Any]]:
    """What the page shows of the run's newest evaluation with ``perturb=``: for each perturbation, success by level."""
    path = run / "robustness.csv"
    with path.open() if path.exists() else io.StringIO() as file:
        rows = [row for row in csv.DictReader(file) if set(row) == set(ROBUSTNESS_COLUMNS)]
    if not rows:
        return []
    newest = {name: rows[-1][name] for name in ("iteration", "command")}
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        name, rate, episodes = row["perturbed"], float(row["success_stochastic"]), int(row["episodes"])
        if newest.items() <= row.items():
            level = _level(name, float(row["level"]), float(row["action_s"]))
            found.setdefault(name, {})[level] = {
                "label": level,
                "successes": round(rate * episodes),
                "episodes": episodes,
                "rate": rate,
                "low": float(row["success_stochastic_low"]),
                "high": float(row["success_stochastic_high"]),
            }
    titles = {"none": "the task as it is"} | {name: about for name, (_, about) in PERTURBATIONS.items()}
    return [{"title": titles.get(name, name), "rows": list(levels.values())} for name, levels in found.items()]


def _level(name: str, level: float, action_s: float) -> str:
    if name == "none":
        return "unchanged"
    return f"{level:g} ({1000 * level * action_s:.0f} ms)" if name == "latency" else f"{level:g}"
