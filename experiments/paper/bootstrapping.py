"""What the value function is bootstrapped from: whole episodes, V at cuts, V at cuts and at T.

    python -m experiments.paper.bootstrapping

Draws ``results/bootstrapping.csv`` (a row per evaluation, with the command and the commit that made it) as
``bootstrapping.png``, and prints a table.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.common import RESULTS, in_one_line, options, read
from experiments.paper import style
from rcg_jax.config import option

#: (batch, value_at_horizon) -> (label, line style).
BATCHES = {
    ("episodes", ""): ("whole episodes", "-"),
    ("segments", "false"): ("segments, V at cuts", ":"),
    ("segments", "true"): ("segments, V at cuts and at T", "--"),
}


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.paper.bootstrapping``."""

    results: str = option(str(RESULTS), "folder of the CSV file and of the picture")


def curves(rows: Sequence[Mapping[str, str]]) -> dict[tuple[str, ...], dict[str, list[tuple[float, float]]]]:
    """(task, preset, method, batch, value_at_horizon) -> seed -> (environment steps, success) by iteration."""
    found: dict[tuple[str, ...], dict[str, list[tuple[float, float]]]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("task", "preset", "method", "batch", "value_at_horizon"))
        at = float(row["env_steps"]), float(row["success_stochastic"])
        found.setdefault(key, {}).setdefault(row["seed"], []).append(at)
    return found


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """Success in the last evaluation before all have ended, at about equal steps: mean and seeds, as Markdown."""
    found = curves(rows)
    lines = ["| task, preset | batch | M steps | reverse | uniform |", "|---|---|---|---|---|"]
    for task, preset in dict.fromkeys((key[0], key[1]) for key in found):
        ends = [one[-1][0] for key, seeds in found.items() if key[:2] == (task, preset) for one in seeds.values()]
        for batch, (label, _) in BATCHES.items():
            cells, steps = [], []
            for method in ("reverse", "uniform"):
                seeds = found.get((task, preset, method, *batch), {})
                last = [[p for p in points if p[0] <= 1.02 * min(ends)][-1] for _, points in sorted(seeds.items())]
                steps += [at for at, _ in last]
                each = ", ".join(f"{rate:.2f}" for _, rate in last)
                cells.append(f"{np.mean([rate for _, rate in last]):.2f} ({each})" if last else "")
            if steps:
                span = f"{min(steps) / 1e6:.1f} to {max(steps) / 1e6:.1f}"
                lines.append(f"| {task}, {preset} | {label} | {span} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(results: Path) -> Path | None:
    """Draws the figure; None where there is no CSV file."""
    path = results / "bootstrapping.csv"
    if not path.exists():
        return None
    found = curves(read(path))
    style.use()
    panels = list(dict.fromkeys((key[0], key[1]) for key in found))
    figure = Figure(figsize=(style.WIDTH, 3.9), layout="constrained")
    for k, (task, preset) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), k + 1)
        for (here, its, method, *batch), seeds in found.items():
            if (here, its) != (task, preset):
                continue
            line, colour = BATCHES[batch[0], batch[1]][1], style.colour(method)
            points = [np.array(one).T for _, one in sorted(seeds.items())]
            for at, rate in points:
                axes.plot(at / 1e6, rate, line, color=colour, lw=0.6, alpha=0.4)
            grid = points[0][0]
            mean = np.mean([np.interp(grid, at, rate) for at, rate in points], axis=0)
            axes.plot(grid / 1e6, mean, line, color=colour, lw=2.2)
        axes.set(title=f"{style.title(task)}, preset={preset}", ylim=(0, 1.02), xlim=(0, None))
        axes.set_xlabel("environment steps [million]", fontsize=8.5)
        if not k:
            axes.set_ylabel(r"success on $\rho_0$")
    kinds = [(label, "0.3", line) for label, line in BATCHES.values()]
    style.legend(figure, [*((style.label(name), style.colour(name), "-") for name in ("reverse", "uniform")), *kinds])
    return style.save(figure, results / "bootstrapping.png")


@in_one_line
def main() -> int:
    """Draws and prints the table."""
    results = Path(options(FigureOptions, "experiments.paper.bootstrapping").results)
    path = draw(results)
    if path is None:
        print(f"{results}: no bootstrapping.csv", file=sys.stderr)
        return 2
    print(f"{table(read(results / 'bootstrapping.csv'))}\n\n{path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
