"""Learning curves of a task: collects finished runs into one CSV and draws them beside the paper's end point.

    python -m rcg_jax.run task=ring_peg engine=native seed=0        # and seed=1, seed=2: the runs
    python -m experiments.learning task=ring_peg run_dir=runs        # the CSV and the picture
    python -m experiments.learning task=ring_peg                     # the picture, from the committed CSV

``paper_curves.csv`` holds the published curves, read off the authors' figures (mean within 0.01, band within 0.02), of
the tasks whose figures came as numbers. The unit of their x axis is not certain, so the picture shows only where they
end.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from experiments.report import arguments, commit, machine, write_rows
from rcg_jax.config import Config, flatten
from rcg_jax.evaluate import wilson_interval
from rcg_jax.run_folder import read_config

RESULTS = Path(__file__).parent / "results"
#: Label and colour of each method that is drawn.
METHODS = {
    "reverse": ("reverse curriculum", "#0072B2"),
    "all_starts": ("Brownian from all starts", "#009E73"),
    "uniform": ("uniform starts", "#D55E00"),
    "oracle": ("oracle (rejection sampling)", "#8C510A"),
    "self_play": ("asymmetric self-play", "#CC79A7"),
}


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def command(run: Path) -> str:
    """What a run was started with: the settings in which its ``config.yaml`` differs from the defaults."""
    default = {name: value for name, _, value in flatten(Config())}
    config = read_config(run)
    free = ("run_dir", "task", "seed")
    changed = [f"{name}={value}" for name, _, value in flatten(config) if name not in free and value != default[name]]
    words = [f"python -m rcg_jax.run task={config.task}", *changed, f"seed={run.name.removeprefix('seed')}"]
    return " ".join(words)


def collect(run_dir: Path, task: str, version: str) -> list[dict[str, Any]]:
    """All evaluations of the runs of ``task`` under ``run_dir``; ``version`` is the commit that they ran at, here."""
    about = {**machine(), "commit": version}
    about = {key: about[key] for key in ("device", "cpus", "jax", "mujoco", "commit")}
    rows: list[dict[str, Any]] = []
    for path in sorted((run_dir / task).glob("*/seed*/eval.csv")):
        run = path.parent
        first = {"method": run.parent.name, "seed": run.name.removeprefix("seed")}
        rows += [{**first, **row, **about, "command": command(run)} for row in read(path)]
    return rows


def draw(rows: list[dict[str, Any]], task: str, path: Path) -> None:
    """Success on rho_0 of each seed over env steps, with Wilson intervals."""
    paper = [row for row in read(Path(__file__).parent / "paper_curves.csv") if row["task"] == task]
    figure, axes = plt.subplots(figsize=(7.2, 3.8), dpi=130, layout="constrained")
    for method, (label, colour) in METHODS.items():
        mine = [row for row in rows if row["method"] == method]
        for k, seed in enumerate(sorted({row["seed"] for row in mine})):
            points = sorted(
                (int(r["env_steps"]), int(r["episodes"]), float(r["success_stochastic"]))
                for r in mine
                if r["seed"] == seed
            )
            steps, episodes, success = (np.array(column) for column in zip(*points))
            bounds = np.array([wilson_interval(round(s * n), int(n)) for s, n in zip(success, episodes)])
            axes.plot(steps / 1e6, success, color=colour, lw=1.6, label=f"{label}, one line a seed" if k == 0 else None)
            axes.fill_between(steps / 1e6, *bounds.T, color=colour, alpha=0.15, lw=0)
    for method in sorted({row["method"] for row in rows} & {row["method"] for row in paper}):
        label, colour = METHODS[method]
        last = [row for row in paper if row["method"] == method][-1]
        mean = float(last["mean"])
        axes.axhline(mean, color=colour, ls="--", lw=1.0)
        text = f"paper, {label}, iteration {last['iteration']}"
        axes.annotate(text, (0, mean + 0.012), color=colour, fontsize=8)
    axes.set(
        xlabel="environment steps [million]", ylabel="success on rho_0, stochastic policy", ylim=(0, 1), xlim=(0, None)
    )
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.32), frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main() -> None:
    """Collects if a folder of runs is given, then draws."""
    args = arguments({"task": "ring_peg", "run_dir": "", "commit": "", "csv": "", "out": ""})
    task = args["task"]
    table = Path(args["csv"] or RESULTS / f"{task}.csv")
    picture = Path(args["out"] or table.with_suffix(".png"))
    if args["run_dir"]:
        rows = collect(Path(args["run_dir"]), task, args["commit"] or commit())
        if not rows:
            sys.exit(f"{args['run_dir']}/{task}: no evaluations of runs")
        write_rows(table, rows)
    draw(read(table), task, picture)
    print(picture)


if __name__ == "__main__":
    main()
