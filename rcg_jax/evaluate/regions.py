"""Success on rho_0 by region: by the start's distance to the goal, and by the task's named subsets of S^0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rcg_jax.evaluate.stats import bin_width, wilson_interval

#: Width of the bins of the starts' distance to the goal [m], at least.
BIN = 0.1

#: Columns of a table of regions; ``seed`` is that of the training.
COLUMNS = (
    *("task", "seed", "policy", "region_kind", "region", "successes", "episodes", "low", "high"),
    *("starts_sha256", "method", "env_steps", "engine", "evaluation_seed"),
)

#: A cell of a table; None leaves it empty.
Cell = str | int | float | None


@dataclass(frozen=True)
class Region:
    """Episodes whose starts lie in one part of S^0.

    Attributes:
        kind: ``all``; ``distance``: a bin of the start's distance to the goal; ``composition``: a subset of
            :meth:`rcg_jax.tasks.Task.composition`, or what is not in it.
        name: ``all``; the ends of the bin [m], ``0.1-0.2``; the name of the subset, or ``not`` and that.
        episodes: episodes of each policy, at least 1.
        successes_stochastic, successes_mean: how many of them reached the goal.
    """

    kind: str
    name: str
    episodes: int
    successes_stochastic: int
    successes_mean: int


def make_regions(
    distance: np.ndarray,
    subsets: Mapping[str, np.ndarray],
    stochastic: np.ndarray,
    mean: np.ndarray,
    *,
    bins: int = 30,
) -> list[Region]:
    """Sorts E episodes of each policy into regions; those without an episode are left out.

    Args:
        distance: (E,) distance of the starts to the goal [m].
        subsets: which starts are in each of the task's subsets, {name: (E,) bool}.
        stochastic, mean: (E,) bool, success of the stochastic policy and of its mean action.
        bins: of the distance, about so many at most.
    """
    parts = {("all", "all"): np.ones(len(distance), bool)}
    width = bin_width(float(distance.max()), BIN, bins)
    index = np.floor(distance / width + 1e-6).astype(int)
    for k in range(int(index.max()) + 1):
        parts["distance", f"{k * width:.1f}-{(k + 1) * width:.1f}"] = index == k
    # Subsets that divide S^0, such as the cells of a maze, need no complements.
    others = [inside for name, inside in subsets.items() if name != "at_goal"]
    divide = len(others) > 1 and bool(np.all(np.sum(others, axis=0) == 1))
    for name, inside in subsets.items():
        parts["composition", name] = inside
        if name == "at_goal" or not divide:
            parts["composition", f"not {name}"] = ~inside
    return [
        Region(kind, name, int(np.sum(inside)), int(np.sum(stochastic & inside)), int(np.sum(mean & inside)))
        for (kind, name), inside in parts.items()
        if inside.any()
    ]


def region_rows(regions: Sequence[Region], **about: Cell) -> list[dict[str, Cell]]:
    """Two rows of :data:`COLUMNS` per region, one for each policy, with 95 % Wilson intervals.

    ``about`` are the columns that are the same in all rows.
    """
    rows: list[dict[str, Cell]] = []
    for one in regions:
        for policy, successes in (("stochastic", one.successes_stochastic), ("mean", one.successes_mean)):
            low, high = wilson_interval(successes, one.episodes)
            cells = {**about, "policy": policy, "region_kind": one.kind, "region": one.name}
            cells |= {"successes": successes, "episodes": one.episodes, "low": low, "high": high}
            rows.append({name: cells[name] for name in COLUMNS})
    return rows


def region_table(regions: Sequence[Region]) -> str:
    """Success by region as text."""
    lines: list[str] = []
    columns = f"{'episodes':>8}{'stochastic':>12}  {'95 % interval':<15}{'mean':>7}  95 % interval"
    for kind, title, unit in (("distance", "distance of start", " m"), ("composition", "part of S^0", "")):
        mine = [region for region in regions if region.kind == kind]
        lines += ["", f"{title:<20}{columns}"] if mine else []
        for one in mine:
            cells = f"{one.name + unit:<20}{one.episodes:>8}"
            for width, successes in ((12, one.successes_stochastic), (7, one.successes_mean)):
                low, high = wilson_interval(successes, one.episodes)
                cells += f"{successes / one.episodes:>{width}.3f}  {f'[{low:.3f}, {high:.3f}]':<15}"
            lines.append(cells.rstrip())
    return "\n".join(lines[1:])
