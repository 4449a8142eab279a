"""The table and the picture of the race, from race.csv and race_curves.csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from experiments.common import read
from experiments.paper import style
from experiments.race.entrants import ENTRANTS

_COLOURS = (
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#0072B2",
    "#56B4E9",
    "#8C510A",
    "#777777",
    "#E69F00",
    "#F0E442",
    "#000000",
)


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """One row for each task and trainer: the median over its seeds; a level that a seed missed counts as infinite."""
    titles = (
        "task",
        "trainer",
        "seeds",
        "minutes to 0.45",
        "to 0.9",
        "M steps to 0.9",
        "success (mean action)",
        "after",
    )
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for task, name in sorted(
        {(row["task"], row["trainer"]) for row in rows}, key=lambda key: (key[0], list(ENTRANTS).index(key[1]))
    ):
        mine = [row for row in rows if (row["task"], row["trainer"]) == (task, name)]
        cells = [_median(mine, "minutes_to_0.45"), _median(mine, "minutes_to_0.9"), _median(mine, "steps_to_0.9", 1e6)]
        stochastic, mean = (np.mean([float(row[f"success_{kind}"]) for row in mine]) for kind in ("stochastic", "mean"))
        end = np.median([float(row["minutes"]) for row in mine])
        words = f"{ENTRANTS[name].words} {mine[0]['version']}" if ENTRANTS[name].rival else ENTRANTS[name].words
        lines.append(
            f"| {task} | {words} | {len(mine)} | {' | '.join(cells)} | {stochastic:.3f} ({mean:.3f}) | {end:.0f} min |"
        )
    return "\n".join(lines)


def _median(rows: Sequence[Mapping[str, str]], column: str, unit: float = 1.0) -> str:
    """The median, with the least and the greatest; a dash where most of the seeds never got there."""
    values = sorted(float(row[column]) / unit if row[column] else np.inf for row in rows)
    middle = float(np.median(values)) if np.isfinite(values).sum() * 2 > len(values) else np.inf
    if not np.isfinite(middle):
        return "not reached"
    last = f"{values[-1]:.1f}" if np.isfinite(values[-1]) else "not reached"
    return f"{middle:.1f}" if len(values) == 1 else f"{middle:.1f} ({values[0]:.1f} to {last})"


def draw(results: Path) -> Path | None:
    """Success over minutes, one panel for each task; None without race_curves.csv."""
    path = results / "race_curves.csv"
    if not path.exists():
        return None
    points = read(path)
    tasks = list(dict.fromkeys(point["task"] for point in points))
    style.use()
    figure, panels = plt.subplots(1, len(tasks), figsize=(style.WIDTH * max(0.6, len(tasks) / 2), 4.2), squeeze=False)
    for axes, task in zip(panels[0], tasks):
        for (name, entrant), colour in zip(ENTRANTS.items(), _COLOURS):
            seeds = {point["seed"] for point in points if (point["task"], point["trainer"]) == (task, name)}
            for seed in sorted(seeds):
                mine = [p for p in points if (p["task"], p["trainer"], p["seed"]) == (task, name, seed)]
                minutes = [float(point["seconds"]) / 60 for point in mine]
                success = [float(point["stochastic"]) for point in mine]
                label = entrant.words.replace("Stable-Baselines3", "SB3") if seed == min(seeds) else None
                axes.plot(minutes, success, color=colour, label=label, linewidth=2.2 if name == "ours" else 1.2)
        axes.axhline(0.9, color="0.6", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", ylim=(0, 1), xlabel="minutes since the command was started", title=style.title(task))
    panels[0][0].set_ylabel("success on rho_0, stochastic policy")
    shown = {label: line for axes in panels[0] for line, label in zip(*axes.get_legend_handles_labels())}
    order = sorted(shown, key=lambda label: shown[label].get_color() != _COLOURS[0])  # ours first
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.055 * -(-len(shown) // 3)))
    figure.legend([shown[label] for label in order], order, loc="upper center", ncols=3, fontsize="small")
    figure.savefig(results / "race.png", dpi=style.DPI)
    plt.close(figure)
    return results / "race.png"
