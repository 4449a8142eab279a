"""Success of the final policy by where an episode began: the distance to the goal, and the task's named regions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rcg_jax.evaluate import wilson_interval
from rcg_jax.report.points import Places

#: Bins of distance, at most.
_BINS = 12


@dataclass(frozen=True)
class Outcomes:
    """The episodes of the final evaluation with the stochastic policy, E of them.

    Attributes:
        iteration: of the policy.
        qpos: (E, nq) where they began.
        success: (E,) bool, reached the goal.
        steps: (E,) until then, or until the end.
    """

    iteration: int
    qpos: np.ndarray
    success: np.ndarray
    steps: np.ndarray


def share(label: str, success: np.ndarray) -> dict[str, Any]:
    """A row of a table: successes among (n,) episodes, with the 95 % Wilson interval."""
    good, number = int(np.sum(success)), len(success)
    low, high = wilson_interval(good, number)
    return {
        "label": label,
        "successes": good,
        "episodes": number,
        "rate": good / number,
        "low": low,
        "high": high,
    }


def by_distance(places: Places, success: np.ndarray) -> list[dict[str, Any]]:
    """Success by the start's distance to the goal; bins without an episode are left out."""
    width = _width(float(places.distance.max()))
    digits = max(0, int(np.ceil(-np.log10(width) - 1e-9)))
    bins = np.floor(places.distance / width + 1e-6).astype(int)
    return [
        share(f"{one * width:.{digits}f}–{(one + 1) * width:.{digits}f} m", success[bins == one])
        for one in np.unique(bins)
    ]


def _width(far: float) -> float:
    """Width of the bins from 0 to ``far`` [m]: 1, 2 or 5 times a power of ten."""
    scale = float(10.0 ** np.floor(np.log10(max(far, 1e-6) / _BINS)))
    return next(step * scale for step in (1, 2, 5, 10) if far <= _BINS * step * scale * 1.001)


def by_region(places: Places, success: np.ndarray) -> list[dict[str, Any]]:
    """Success in each named region that has an episode, and outside of all of them."""
    regions = {name: mask for name, mask in places.regions.items() if mask.any()}
    rest = ~np.any([*regions.values(), np.zeros(len(success), bool)], axis=0)
    rows = [share(name, success[mask]) for name, mask in regions.items()]
    return [*rows, share("elsewhere", success[rest])] if rows and rest.any() else rows
