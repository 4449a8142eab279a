"""Figure 5 (appendix B.1): what the distance to the goal as an additional penalty does to learning.

    python -m experiments.paper.distance_reward

Reads ``results/curves_<task>.csv`` and writes ``fig5_distance_reward.png``: the curriculum and uniform starts, each
with the sparse reward and with ``reward=distance``. The paper found the ring task little affected and the key task
worse off.
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
from rcg_jax.config.settings import Config, option

_METHODS = ("reverse", "uniform")
_REWARDS = {"sparse": ("sparse", "-"), "distance": ("distance", "--")}


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.paper.distance_reward``."""

    results: str = option(str(RESULTS), "folder of the CSV files and of the picture")


def draw(results: Path) -> tuple[Path | None, list[str]]:
    """Draws the figure; returns its path, None without any runs, and what is missing."""
    style.use()
    figure = Figure(figsize=(style.WIDTH, 4.6), layout="constrained")
    used: list[Seeds] = []
    for axes, task in zip(figure.subplots(1, 2, sharey=True), ARM, strict=True):
        curves, counts, absent = load(task, results), {}, []
        for method in _METHODS:
            for reward, (_, line) in _REWARDS.items():
                name = f"{method} {reward}"
                if each := find(curves, method, reward=reward):
                    counts[name] = plot(axes, each, "success_stochastic", line)
                    used.append(each)
                else:
                    absent.append(name)
        style.over_steps(axes, task, counts, absent)
        if not counts:
            style.empty(axes, f"no runs yet: {command(task)}")
    style.legend(
        figure,
        [
            (f"{style.label(method).partition(' (')[0]}, {words} reward", style.colour(method), line)
            for method in _METHODS
            for reward, (words, line) in _REWARDS.items()
            if any((each.curve.method, each.curve.reward) == (method, reward) for each in used)
        ],
    )
    figure.axes[0].set_ylabel(r"success on $\rho_0$")
    style.note(
        figure,
        [
            f"Dashed: in each step a penalty of distance_weight (default {Config().distance_weight:g} per metre) times "
            "the distance to the goal; the measure is success in both cases. Mean over seeds, shaded one standard "
            "deviation, thin lines single seeds.",
            *sources(used, results),
        ],
    )
    path = style.save(figure, results / "fig5_distance_reward.png") if used else None
    return path, missing(needed(lambda c: c.task in ARM and c.method in _METHODS and c.preset == "default"), used)


@in_one_line
def main() -> int:
    """Draws, and says what is missing."""
    chosen = options(FigureOptions, "experiments.paper.distance_reward")
    path, lacking = draw(Path(chosen.results))
    print("\n".join([str(path or "nothing to draw yet"), *lacking]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
