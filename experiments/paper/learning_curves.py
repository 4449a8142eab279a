"""Figure 2: success on rho_0 while each method learns the four tasks, and the published curves beside ours.

    python -m experiments.paper.learning_curves                  # our defaults: fig2_learning_curves.png
    python -m experiments.paper.learning_curves preset=paper     # fig2_learning_curves_paper.png

Reads ``results/curves_<task>.csv``; ``published_curves.csv`` holds the published curves of the arm tasks, read off the
authors' figures, those of the mazes are not available as numbers. A row of the
published curves is a curriculum iteration of the Brownian methods and a TRPO iteration of the uniform baseline: with
``preset=paper`` both are drawn over curriculum iterations. Our defaults have other iterations; there the published
curves have a panel of their own, and heights compare, times do not.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common import RESULTS, in_one_line, options, read
from experiments.paper import style
from experiments.paper.curves import PAPER_CURVES, Seeds, find, load, missing, needed, plot, sources
from experiments.paper.curves import command as runs_command
from experiments.paper.plan import Curve
from rcg_jax.config.names import TASKS
from rcg_jax.config.settings import option

#: The grid's columns; each task has half of them, and the published curves stand to the right there.
_COLUMNS = 12


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.paper.learning_curves``."""

    preset: str = option("default", "which runs", choices=("default", "paper"))
    results: str = option(str(RESULTS), "folder of the CSV files and of the picture")


def published(task: str) -> dict[str, np.ndarray]:
    """method -> (K, 4) iteration, mean, low, high of the published curves; NaN where the band was not readable."""
    found: dict[str, list[list[float]]] = {}
    for row in read(PAPER_CURVES):
        if row["task"] == task:
            cells = [float(row[name]) if row[name] else np.nan for name in ("iteration", "mean", "low", "high")]
            found.setdefault(row["method"], []).append(cells)
    return {method: np.array(rows) for method, rows in found.items()}


def _panel(axes: Axes, task: str, curves: Sequence[Seeds], preset: str, *, wanted: Sequence[Curve], width: int) -> None:
    counts = {}
    for method in reversed(style.in_order(each.curve.method for each in curves)):
        seeds = find(curves, method, preset=preset)
        assert seeds is not None
        counts[method] = plot(axes, seeds, "success_stochastic")
    counts = {method: counts[method] for method in style.in_order(counts)}
    absent = style.in_order(c.method for c in wanted if c.task == task and c.method not in counts)
    style.over_steps(axes, task, counts, absent, width)
    if not curves:
        style.empty(axes, f"no runs yet: {runs_command(task, 'cpu')}")


def _published_panel(axes: Axes, curves: dict[str, np.ndarray]) -> None:
    for method in style.in_order(curves):
        at, mean, low, high = curves[method].T
        known = ~np.isnan(low) & ~np.isnan(high)
        axes.fill_between(at[known], low[known], high[known], color=style.colour(method), alpha=0.12, lw=0)
        axes.plot(at, mean, ":", color=style.colour(method), lw=2.2)
    axes.set(xlim=(0, 2_050))
    axes.set_xlabel("published: iteration", fontsize=8.5)
    axes.set_xticks([0, 1_000, 2_000], ["0", "1k", "2k"])
    axes.set_title("published", fontweight="normal", color="0.4", fontsize=10)
    axes.tick_params(labelleft=False)


#: TRPO iterations of a curriculum iteration. A row of the published curves is one curriculum iteration for the Brownian
#: methods, one TRPO iteration for uniform starts.
_INNER = 5


def _over_iterations(axes: Axes, task: str, curves: Sequence[Seeds], theirs: dict[str, np.ndarray]) -> None:
    """Ours and the published curves over curriculum iterations of 5 x 50,000 steps."""
    for method in style.in_order(theirs):
        at, mean, low, high = theirs[method].T
        at = at / (_INNER if method == "uniform" else 1)
        known = ~np.isnan(low) & ~np.isnan(high)
        axes.fill_between(at[known], low[known], high[known], color=style.colour(method), alpha=0.10, lw=0)
        axes.plot(at, mean, ":", color=style.colour(method), lw=2.2)
    counts = {}
    for seeds in curves:
        lines = []
        for series in seeds.furthest.values():
            there = ~np.isnan(series.columns["success_stochastic"])
            lines.append((series.columns["iteration"][there], series.columns["success_stochastic"][there]))
            axes.plot(*lines[-1], color=style.colour(seeds.curve.method), lw=0.7, alpha=0.4)
        grid = lines[0][0]
        mean = np.mean([np.interp(grid, at, values) for at, values in lines], axis=0)
        axes.plot(grid, mean, color=style.colour(seeds.curve.method), lw=2.2)
        counts[seeds.curve.method] = len(lines)
    seeds_text = ", ".join(f"{name} {counts[name]}" for name in style.in_order(counts))
    axes.set(title=style.title(task), ylim=(0, 1.02), xscale="log", xlim=(2, 2_050))
    axes.set_xticks(
        [2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000], ["2", "5", "10", "20", "50", "100", "200", "500", "1k", "2k"]
    )
    axes.minorticks_off()
    axes.set_xlabel(f"curriculum iterations of 250,000 steps\nseeds: {seeds_text}", fontsize=8.5)


def draw_paper(results: Path) -> tuple[Path | None, list[str]]:
    """``preset=paper`` with the published curves in the same panels; returns as :func:`draw` does."""
    style.use()
    figure = Figure(figsize=(style.WIDTH, 7.4), layout="constrained")
    used: list[Seeds] = []
    for k, task in enumerate(TASKS):
        axes = figure.add_subplot(2, 2, k + 1)
        mine = [
            each
            for each in load(task, results)
            if (each.curve.preset, each.curve.reward) == ("paper", "sparse") and each.of_today
        ]
        if not mine:
            style.empty(axes, "no runs yet")
        _over_iterations(axes, task, mine, published(task))
        axes.set_ylabel(r"success on $\rho_0$")
        used += mine
    shown = style.in_order(each.curve.method for each in used)
    style.legend(figure, [(style.label(name), style.colour(name), "-") for name in shown])
    style.note(
        figure,
        [
            "Solid: ours with preset=paper, stochastic policy on the task's feasible starts, mean and single seeds. "
            "Dotted: published mean of 5 seeds and band, read off the authors' figures (+-0.01, band +-0.02); the "
            "mazes' are not available.",
            *sources(used, results),
        ],
    )
    path = results / "fig2_learning_curves_paper.png"
    return style.save(figure, path) if used else None, missing(needed(lambda c: c.preset == "paper"), used)


def draw(results: Path, preset: str = "default") -> tuple[Path | None, list[str]]:
    """Draws the figure; returns its path, None without any runs, and what is missing."""
    if preset == "paper":
        return draw_paper(results)
    style.use()
    wanted = needed(lambda c: c.preset == preset and c.reward == "sparse")
    tasks = [task for task in TASKS if any(curve.task == task for curve in wanted)]
    rows = -(-len(tasks) // 2)
    figure = Figure(figsize=(style.WIDTH, 1.2 + 3.1 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, _COLUMNS)
    used: list[Seeds] = []
    first: Axes | None = None
    for k, task in enumerate(tasks):
        row, left = k // 2, k % 2 * _COLUMNS // 2
        theirs = published(task)
        split = _COLUMNS // 2 - 2 * bool(theirs)
        axes = figure.add_subplot(grid[row, left : left + split], sharey=first)
        first = first or axes
        mine = [each for each in load(task, results) if each.curve == Curve(task, each.curve.method, preset=preset)]
        _panel(axes, task, mine, preset, wanted=wanted, width=15 * split - 6)
        if k % 2 == 0:
            axes.set_ylabel(r"success on $\rho_0$")
        used += mine
        if theirs:
            _published_panel(figure.add_subplot(grid[row, left + split : left + 6], sharey=axes), theirs)
    shown = style.in_order(each.curve.method for each in used)
    style.legend(figure, [(style.label(name), style.colour(name), "-") for name in shown])
    style.note(
        figure,
        [
            "Ours: stochastic policy on the task's feasible starts; mean over seeds, shaded one standard deviation, "
            "thin lines single seeds, also where there is only one; steps of policy rollouts only.",
            *sources(used, results),
            "Published (dotted): mean of 5 seeds and band, read off the authors' figures (+-0.01, band +-0.02). The "
            "unit of their x axis is not certain: heights compare, times do not. The mazes' are not available.",
        ],
    )
    name = "fig2_learning_curves" + ("" if preset == "default" else f"_{preset}")
    lacking = missing(wanted, used)
    return style.save(figure, results / f"{name}.png") if used else None, lacking


@in_one_line
def main() -> int:
    """Draws, and says what is missing."""
    chosen = options(FigureOptions, "experiments.paper.learning_curves")
    path, lacking = draw(Path(chosen.results), chosen.preset)
    print("\n".join([str(path or "nothing to draw yet"), *lacking]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
