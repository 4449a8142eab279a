"""Success of the final policy by where an episode began."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rcg_jax.evaluation.regions import Region, make_regions
from rcg_jax.evaluation.stats import wilson_interval
from rcg_jax.report.points import Places

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


def success(outcomes: Outcomes, places: Places, names: Mapping[str, str]) -> dict[str, Any]:
    """What the page shows: success in all, by the start's distance to the goal, and by the task's named regions.

    Args:
        outcomes: the episodes.
        places: where they began.
        names: what regions are called, by name; others by their own.
    """
    regions = make_regions(places.distance, places.regions, outcomes.stochastic, outcomes.mean, bins=MOST_BINS)
    reached = outcomes.steps[outcomes.stochastic]
    return {
        "iteration": outcomes.iteration,
        "all": _rows(regions, "all")[0],
        "distance": _rows(regions, "distance"),
        # Nearly all starts are not at the goal.
        "region": _rows([one for one in regions if one.name != "not at_goal"], "composition", names),
        "steps": float(np.mean(reached)) if len(reached) else None,
    }


def _label(name: str, names: Mapping[str, str]) -> str:
    whole, inside = name.removeprefix("not "), not name.startswith("not ")
    words = names.get(whole, whole.replace("_", " "))
    return words if inside else f"not {words}"


def _rows(regions: Sequence[Region], kind: str, names: Mapping[str, str] | None = None) -> list[dict[str, Any]]:
    rows = []
    for one in regions:
        if one.kind == kind:
            low, high = wilson_interval(one.successes_stochastic, one.episodes)
            rows.append(
                {
                    "label": f"{one.name.replace('-', '–')} m" if kind == "distance" else _label(one.name, names or {}),
                    "successes": one.successes_stochastic,
                    "episodes": one.episodes,
                    "rate": one.successes_stochastic / one.episodes,
                    "mean": one.successes_mean / one.episodes,
                    "low": low,
                    "high": high,
                }
            )
    return rows
