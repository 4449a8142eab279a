"""The table: success on rho_0 at the end of the runs of every curve, and what it took.

    python -m experiments.final_table

Reads ``results/runs.csv`` and the curves, writes ``results/final.csv`` and prints it as Markdown.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments import style
from experiments.curves import Seeds, about, group, interval, load
from experiments.report import RESULTS, in_one_line, options, write_rows
from rcg_jax.config import option

_CAPTION = "mean over seeds with 95 % Student interval; over the run: mean of all evaluations"


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.final_table``."""

    results: str = option(str(RESULTS), "folder of the CSV files")


def row(seeds: Seeds, runs: list[dict[str, str]]) -> dict[str, Any] | None:
    """One curve; None where no seed was evaluated."""
    whole = seeds.furthest
    finals = {seed: run.of("success_stochastic")[1] for seed, run in whole.items()}
    finals = {seed: values for seed, values in finals.items() if len(values)}
    if not finals:
        return None
    ends = np.array([values[-1] for values in finals.values()])
    low, high = interval(ends)
    some = next(iter(whole.values()))
    mine = [each for each in runs if int(each["seed"]) in whole]
    seconds = [float(each["seconds"]) for each in mine if each["seconds"]]
    spent = [run.columns["proposal_steps"][-1] for run in whole.values()]
    return {
        "task": seeds.curve.task,
        "method": seeds.curve.method,
        "reward": seeds.curve.reward,
        "preset": seeds.curve.preset,
        "settings": seeds.settings,
        "config": seeds.config,
        "seeds": len(ends),
        "unfinished": len(seeds.runs) - len(whole),
        "iterations": some.iterations,
        "env_steps": int(some.columns["env_steps"][-1]),
        "success": round(float(ends.mean()), 4),
        "success_low": "" if math.isnan(low) else round(low, 4),
        "success_high": "" if math.isnan(high) else round(high, 4),
        "success_worst": round(float(ends.min()), 4),
        "success_best": round(float(ends.max()), 4),
        "mean_over_run": round(float(np.mean([values.mean() for values in finals.values()])), 4),
        "proposal_steps": "" if np.isnan(spent).any() else int(np.mean(spent)),
        "seconds": round(float(np.mean(seconds)), 1) if seconds else "",
        "engine": "+".join(sorted({each["engine"] for each in mine})),
        "device": "+".join(sorted({each["device"] for each in mine})),
        "commit": "+".join(sorted({each["commit"] or "not recorded" for each in mine})),
    }


def tabulate(results: Path) -> list[dict[str, Any]]:
    """A row per curve that there are runs of."""
    runs = about(results)
    rows = []
    for table in sorted(results.glob("curves_*.csv")):
        for seeds in load(table.stem.removeprefix("curves_"), results):
            key = (seeds.curve, seeds.settings, seeds.config)
            one = row(seeds, [each for each in runs if group(each) == key])
            if one is not None:
                rows.append(one)
    order = style.in_order(each["method"] for each in rows)
    return sorted(rows, key=lambda r: (r["task"], r["preset"], r["reward"], order.index(r["method"])))


def markdown(rows: list[dict[str, Any]]) -> str:
    """For a page."""
    lines = ["| task | method | seeds | M steps | success on rho_0 | worst, best | over the run |", "|" + "---|" * 7]
    for r in rows:
        words = [r["method"]] + [f"{name}={r[name]}" for name, usual in (("reward", "sparse"), ("preset", "default"))
                                 if r[name] != usual]  # fmt: skip
        bounds = f" [{r['success_low']:.2f}, {r['success_high']:.2f}]" if r["success_low"] != "" else ""
        cells = [r["task"], " ".join(words), r["seeds"], f"{r['env_steps'] / 1e6:.1f}", f"{r['success']:.3f}{bounds}"]
        cells += [f"{r['success_worst']:.3f}, {r['success_best']:.3f}", f"{r['mean_over_run']:.3f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Writes and prints the table."""
    results = Path(options(FigureOptions, "experiments.final_table").results)
    rows = tabulate(results)
    if not rows:
        print(f"{results}: no runs yet; make reproduce BUDGET=cpu makes them")
        return 0
    write_rows(results / "final.csv", rows)
    print(f"{markdown(rows)}\n\n{_CAPTION}\n{results / 'final.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
