"""Figure 3: the share of good starts among those trained on, when new ones come from good starts or from all.

    python -m experiments.paper.good_starts

Reads ``results/curves_<task>.csv`` and writes ``fig3_good_starts.png``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from experiments.common import RESULTS, in_one_line, options
from experiments.paper import style
from experiments.paper.curves import Seeds, command, find, load, missing, needed, plot, sources
from experiments.paper.plan import ARM
from rcg_jax.config.settings import option

_METHODS = ("reverse", "all_starts")


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.paper.good_starts``."""

    results: str = option(str(RESULTS), "folder of the CSV files and of the picture")


def draw(results: Path) -> tuple[Path | None, list[str]]:
    """Draws the figure; returns its path, None without any runs, and what is missing."""
    style.use()
    figure = Figure(figsize=(style.WIDTH, 4.2), layout="constrained")
    used: list[Seeds] = []
    for axes, task in zip(figure.subplots(1, 2, sharey=True), ARM, strict=True):
        found = [each for method in _METHODS if (each := find(load(task, results), method))]
        mine = [each for each in found if any(len(run.of("share_good")[1]) for run in each.runs.values())]
        counts = {each.curve.method: plot(axes, each, "share_good") for each in mine}
        style.over_steps(axes, task, counts, [name for name in _METHODS if name not in counts])
        if not mine:
            style.empty(axes, f"no training metrics yet: {command(task)}")
        used += mine
    shown = style.in_order(each.curve.method for each in used)
    style.legend(figure, [(style.label(name), style.colour(name), "-") for name in shown])
    figure.axes[0].set_ylabel("share of good starts")
    style.note(
        figure,
        [
            r"Good: solved in 10 % to 90 % of at least two episodes of the iteration; share among the starts that had "
            "so many, replayed ones included. Mean over seeds, shaded one standard deviation, thin lines single seeds.",
            *sources(used, results),
        ],
    )
    path = style.save(figure, results / "fig3_good_starts.png") if used else None
    return path, missing(
        needed(lambda c: c.task in ARM and c.method in _METHODS and c.reward == "sparse" and c.preset == "default"),
        used,
    )


@in_one_line
def main() -> int:
    """Draws, and says what is missing."""
    chosen = options(FigureOptions, "experiments.paper.good_starts")
    path, lacking = draw(Path(chosen.results))
    print("\n".join([str(path or "nothing to draw yet"), *lacking]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
