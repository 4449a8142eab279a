"""The methods that the paper compares, on one task: one command, one argument apart (section 5, figure 2a).

    python -m experiments.compare task=point_maze

trains every method on every seed, one after the other, and writes results/compare_<task>.csv (every evaluation),
compare_<task>_summary.csv and compare_<task>.png. Runs are those of ``python -m rcg_jax.run``: finished ones are not
repeated, and a broken one goes on where it stopped. Steps that a method spends on finding starts (walks, labels, Alice)
are not among the environment steps of the x axis; the summary has them as ``proposal_steps``, and
``experiments.method_cost`` measures what a method costs in time.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from experiments.learning import METHODS as STYLES
from experiments.learning import collect, read
from experiments.report import arguments, commit, write_rows
from rcg_jax.config import Config
from rcg_jax.methods import make_method
from rcg_jax.names import METHODS
from rcg_jax.own_name import class_name
from rcg_jax.progress import duration
from rcg_jax.tasks import make_task

DEFAULTS = {
    "task": "point_maze",
    "methods": ",".join(METHODS),
    "seeds": "0,1,2",
    "engine": "native",
    "iterations": 40,
    "eval_every": 4,
    "run_dir": "runs/compare",
    "settings": "",  # more settings of the runs, separated by ;
    "out": "experiments/results",  # folder of the CSV files and the picture
    "draw": 0,  # 1: only draws, from the committed CSV
}


def train(args: dict[str, Any], methods: Sequence[str], seeds: Sequence[str]) -> None:
    """Runs what is not finished yet; a run that fails stops the comparison with its exit code."""
    plan = [(method, seed) for seed in seeds for method in methods]
    begin = time.monotonic()
    for k, (method, seed) in enumerate(plan):
        elapsed = time.monotonic() - begin
        left = f", ETA {duration(elapsed / k * (len(plan) - k))}" if k else ""
        print(f"[{k + 1}/{len(plan)}] {args['task']} method={method} seed={seed}{left}", flush=True)
        words = [f"{key}={args[key]}" for key in ("task", "engine", "iterations", "eval_every", "run_dir")]
        words += [f"method={method}", f"seed={seed}", *filter(None, args["settings"].split(";"))]
        done = subprocess.run([sys.executable, "-m", "rcg_jax.run", *words])
        if done.returncode:
            sys.exit(done.returncode)


def check(args: dict[str, Any], methods: Sequence[str]) -> None:
    """Refuses, before the first run, what the last one would refuse: a task, or a method that it does not support."""
    try:
        task = make_task(args["task"], args["engine"])
        for method in methods:
            make_method(method, task, Config(task=args["task"], method=method))
    except (ValueError, RuntimeError) as error:
        sys.exit(f"{error}; choose with methods={','.join(methods)}")


def summary(args: dict[str, Any], rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> list[dict[str, Any]]:
    """Per method: success on rho_0 at the end over the seeds, and what it cost."""
    out = []
    for method in methods:
        mine = [row for row in rows if row["method"] == method]
        finals = []
        for seed in sorted({row["seed"] for row in mine}):
            last = max(
                (row for row in mine if row["seed"] == seed), key=lambda r: (int(r["env_steps"]), int(r["episodes"]))
            )
            finals.append(last)
        success = np.array([float(row["success_stochastic"]) for row in finals])
        folder = Path(args["run_dir"]) / class_name(args["task"]) / method
        logs = [read(folder / f"seed{row['seed']}" / "metrics.csv") for row in finals]
        out.append(
            {
                "task": args["task"],
                "method": method,
                "seeds": len(finals),
                "env_steps": int(finals[0]["env_steps"]),
                "success_mean": round(float(success.mean()), 4),
                "success_std": round(float(success.std()), 4),
                "success_worst": round(float(success.min()), 4),
                "success_best": round(float(success.max()), 4),
                "mean_over_run": round(_area(mine), 4),
                "proposal_steps": int(np.mean([sum(float(row["proposal_steps"]) for row in log) for log in logs])),
            }
        )
    for row in out:
        row["commit"] = commit()
        row["command"] = "python -m experiments.compare " + " ".join(sys.argv[1:])
    return out


def _area(rows: Sequence[dict[str, Any]]) -> float:
    """Mean over the seeds of the mean success over the evaluations: how early, not only how far."""
    seeds = sorted({row["seed"] for row in rows})
    return float(np.mean([np.mean([float(r["success_stochastic"]) for r in rows if r["seed"] == s]) for s in seeds]))


def draw(rows: Sequence[dict[str, Any]], task: str, methods: Sequence[str], path: Path) -> None:
    """Success on rho_0 over environment steps: the mean over the seeds, and each seed thinly."""
    figure, axes = plt.subplots(figsize=(7.2, 4.2), dpi=130, layout="constrained")
    for method in methods:
        label, colour = STYLES[method]
        curves = {}
        for seed in sorted({row["seed"] for row in rows if row["method"] == method}):
            mine = [row for row in rows if row["method"] == method and row["seed"] == seed]
            curves[seed] = dict(sorted((int(row["env_steps"]), float(row["success_stochastic"])) for row in mine))
        if not curves:
            continue
        steps = sorted(set.intersection(*(set(curve) for curve in curves.values())))
        values = np.array([[curve[s] for s in steps] for curve in curves.values()])
        for line in values:
            axes.plot(np.array(steps) / 1e6, line, color=colour, lw=0.7, alpha=0.45)
        axes.plot(np.array(steps) / 1e6, values.mean(axis=0), color=colour, lw=2.2, label=label)
    axes.set(
        xlabel="environment steps [million]",
        ylabel=r"success on $\rho_0$, stochastic policy",
        ylim=(0, 1),
        xlim=(0, None),
        title=f"{task}: mean over seeds (thin: each seed)",
    )
    axes.legend(frameon=False, fontsize=9, loc="best")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Trains, collects, draws."""
    args = arguments(DEFAULTS)
    methods, seeds = args["methods"].split(","), args["seeds"].split(",")
    unknown = [method for method in methods if method not in METHODS]
    if unknown:
        sys.exit(f"methods={args['methods']}: {unknown[0]} is none of {', '.join(METHODS)}")
    name = class_name(args["task"])
    table = Path(args["out"]) / f"compare_{name}.csv"
    if not args["draw"]:
        begin = time.monotonic()
        check(args, methods)
        train(args, methods, seeds)
        rows = collect(Path(args["run_dir"]), name, commit())
        write_rows(table, rows)
        found = summary(args, rows, methods)
        write_rows(table.with_name(f"compare_{name}_summary.csv"), found)
        for row in found:
            print(
                f"{row['method']:11s} {row['success_mean']:.3f} ({row['success_worst']:.3f} to "
                f"{row['success_best']:.3f}), over the run {row['mean_over_run']:.3f}"
            )
        print(f"{duration(time.monotonic() - begin)} in all")
    picture = table.with_suffix(".png")
    draw(read(table), name, methods, picture)
    print(picture)


if __name__ == "__main__":
    main()
