"""Learning curves of ring_peg: collects finished runs into one CSV and draws them beside the paper's end point.

    python -m rcg_jax.run task=ring_peg engine=native seed=0        # and seed=1, seed=2: the runs
    python -m experiments.ring_peg run_dir=runs                      # the CSV
    python -m experiments.ring_peg                                   # the picture, from the committed CSV

``paper_curves.csv`` holds the published curves, read off the authors' figures (mean within 0.01, band within 0.02). The
unit of their x axis is not certain, so the picture shows only where they end.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from experiments.report import arguments, commit, machine, write_rows
from rcg_jax.config import Config, flatten
from rcg_jax.evaluate import wilson_interval
from rcg_jax.run_folder import read_config

RESULTS = Path(__file__).parent / "results"
METHODS = {"reverse": ("reverse curriculum", "#0072B2"), "uniform": ("uniform starts", "#D55E00")}


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def command(run: Path) -> str:
    """What a run was started with: the settings in which its ``config.yaml`` differs from the defaults."""
    default = {name: value for name, _, value in flatten(Config())}
    free = ("run_dir", "task", "seed")
    changed = [
        f"{name}={value}" for name, _, value in flatten(read_config(run)) if name not in free and value != default[name]
    ]
    words = ["python -m rcg_jax.run task=ring_peg", *changed, f"seed={run.name.removeprefix('seed')}"]
    return " ".join(words)


def collect(run_dir: Path, version: str) -> list[dict[str, Any]]:
    """All evaluations of all runs under ``run_dir``; ``version`` is the commit that they ran at, on this machine."""
    about = {**machine(), "commit": version}
    about = {key: about[key] for key in ("device", "cpus", "jax", "mujoco", "commit")}
    rows: list[dict[str, Any]] = []
    for path in sorted((run_dir / "ring_peg").glob("*/seed*/eval.csv")):
        run = path.parent
        first = {"method": run.parent.name, "seed": run.name.removeprefix("seed")}
        rows += [{**first, **row, **about, "command": command(run)} for row in read(path)]
    return rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Success on rho_0 of each seed over env steps, with Wilson intervals."""
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
    for method, (label, colour) in METHODS.items():
        last = [
            r
            for r in read(Path(__file__).parent / "paper_curves.csv")
            if r["task"] == "ring_peg" and r["method"] == method
        ][-1]
        axes.axhline(float(last["mean"]), color=colour, ls="--", lw=1.0)
        axes.annotate(
            f"paper, {label}, iteration {last['iteration']}", (0, float(last["mean"]) + 0.012), color=colour, fontsize=8
        )
    axes.set(
        xlabel="environment steps [million]", ylabel="success on rho_0, stochastic policy", ylim=(0, 1), xlim=(0, None)
    )
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.32), frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main() -> None:
    """Collects if a folder of runs is given, then draws."""
    args = arguments(
        {"run_dir": "", "commit": "", "csv": str(RESULTS / "ring_peg.csv"), "out": str(RESULTS / "ring_peg.png")}
    )
    if args["run_dir"]:
        write_rows(Path(args["csv"]), collect(Path(args["run_dir"]), args["commit"] or commit()))
    draw(read(Path(args["csv"])), Path(args["out"]))
    print(args["out"])


if __name__ == "__main__":
    main()
