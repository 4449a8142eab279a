"""The table: success on rho_0 at the end of the runs of every curve, beside the published one, and what it took.

    python -m experiments.paper.results_table

Reads ``runs.csv``, ``curves_<task>.csv`` and ``published_curves.csv``, writes ``results.csv`` and
prints it as Markdown. A row per task, preset and method (and reward):

- ``preset``: ``published``, the end of a curve of the paper as read off its figures; ``paper``: our runs with the
  paper's values; ``default``: our runs with our defaults. Runs of earlier defaults are shown only where there are none
  of the present ones; ``config`` tells them apart.
- ``guided``: ``yes`` where S^0 guides the new starts (``curriculum.rho_0_share=0.5``), which the paper does not assume;
  the others train from the goal state alone, or on rho_0 itself (uniform, oracle).
- ``success_mean``: mean over the seeds of the success of the stochastic policy in their last evaluation;
  ``success_low``, ``success_high``: the worst and the best seed. Of published curves: the band of the figure.
- ``mean_policy_success``: the same mean, of the policy's mean action.
- ``env_steps``: steps of policy rollouts of each seed. Seeds that have not come so far count as ``unfinished`` and for
  nothing else. Empty for published curves, whose x axis has no certain unit.
- ``planned``: iterations that these runs were to have; more than ``iterations`` where they were stopped.
- ``ci_low``, ``ci_high``: 95 % Student interval of the mean over seeds; empty for one seed.
- ``steps_to_0.25`` and so on: steps until the first evaluation of at least that success, mean over the seeds, without
  interpolation; empty unless all seeds reached it. ``reached_0.25``: how many did.
- ``seconds``: wall clock of a process, its evaluations included, mean; it trained ``together`` seeds.
- ``command``: trains all these seeds.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import RESULTS, in_one_line, options, read, write_rows
from experiments.paper import style
from experiments.paper.curves import PAPER_CURVES, Seeds, Series, about, group, interval, load
from rcg_jax.config import option
from rcg_jax.config.names import TASKS

#: Success rates whose first time counts.
LEVELS = (0.25, 0.45, 0.9)

#: Columns that come first, whatever else there is.
COLUMNS = ("task", "preset", "method", "guided", "success_mean", "success_low", "success_high", "mean_policy_success",
           "env_steps", "seeds", "starts_hash", "commit", "command")  # fmt: skip

CAPTION = (
    "Success on rho_0 at the end: mean over seeds (worst to best seed), stochastic policy and mean action; steps until "
    "the first evaluation of at least 0.25, 0.45, 0.9, mean over the seeds if all reached it, or else how many did. "
    "Published: mean of 5 seeds (band of the figure), read off the paper's figures."
)

#: Rows of the paper's figures are means of so many seeds.
_PUBLISHED_SEEDS = 5


@dataclass(frozen=True)
class TableOptions:
    """Settings of ``python -m experiments.paper.results_table``."""

    results: str = option(str(RESULTS), "folder of the CSV files")


def steps_to(run: Series, level: float) -> float:
    """Environment steps at the first evaluation of at least that success; NaN if there is none."""
    steps, success = run.of("success_stochastic")
    reached = success >= level
    return float(steps[np.argmax(reached)]) if reached.any() else math.nan


def joint_command(commands: Sequence[str], seeds: Sequence[int], *, vmapped: bool = False) -> str:
    """One command for runs whose commands differ in the seed alone; otherwise all of them.

    Args:
        commands: those of the single seeds.
        seeds: which.
        vmapped: whether they were trained in one program.
    """
    pattern, words = r"\bseed=\d+\b", ",".join(map(str, sorted(seeds)))
    if vmapped:
        words = f"{min(seeds)} num_seeds={len(seeds)}"
    different = dict.fromkeys(re.sub(pattern, f"seed={words}", line) for line in commands)
    if len(different) > 1 or len(commands) == 1:
        return "; ".join(dict.fromkeys(commands))
    return "".join(different).replace("rcg_jax.run ", "rcg_jax.run " if vmapped else "rcg_jax.run -m ", 1)


def _joined(rows: Sequence[Mapping[str, str]], name: str) -> str:
    return "+".join(sorted({row.get(name, "") or "not recorded" for row in rows}))


def _number(value: float, digits: int = 4) -> float | str:
    return "" if math.isnan(value) else round(value, digits)


def row(seeds: Seeds, runs: Sequence[Mapping[str, str]]) -> dict[str, Any] | None:
    """One curve; None where no seed was evaluated.

    Args:
        seeds: its runs.
        runs: their rows of ``runs.csv``.
    """
    finals = {seed: run for seed, run in seeds.furthest.items() if len(run.of("success_stochastic")[1])}
    if not finals:
        return None
    evaluations = [run.of("success_stochastic")[1] for run in finals.values()]
    means = [run.of("success_mean")[1] for run in finals.values()]
    ends = np.array([values[-1] for values in evaluations])
    low, high = interval(ends)
    some = next(iter(finals.values()))
    mine = [each for each in runs if int(each["seed"]) in finals]
    seconds = [float(each["seconds"]) for each in mine if each["seconds"]]
    shared = "+".join(sorted({each.get("together", "") or "1" for each in mine}))
    spent = [run.columns["proposal_steps"][-1] for run in finals.values()]
    levels: dict[str, Any] = {}
    for level in LEVELS:
        first = np.array([steps_to(run, level) for run in finals.values()])
        levels[f"steps_to_{level:g}"] = "" if np.isnan(first).any() else int(first.mean())
        levels[f"reached_{level:g}"] = int(np.sum(~np.isnan(first)))
    return {
        "task": seeds.curve.task,
        "preset": seeds.curve.preset,
        "method": seeds.curve.method,
        "guided": "yes" if seeds.curve.guided else "no",
        "success_mean": round(float(ends.mean()), 4),
        "success_low": round(float(ends.min()), 4),
        "success_high": round(float(ends.max()), 4),
        "mean_policy_success": _number(float(np.mean([x[-1] if len(x) else math.nan for x in means]))),
        "env_steps": int(some.columns["env_steps"][-1]),
        "seeds": len(ends),
        "starts_hash": _joined(mine, "starts_sha256"),
        "commit": _joined(mine, "commit"),
        "command": joint_command(
            [each["command"] for each in mine if each.get("command")], list(finals), vmapped=shared == str(len(ends))
        ),
        "reward": seeds.curve.reward,
        "settings": seeds.settings,
        "config": seeds.config,
        "present_defaults": "yes" if seeds.of_today else "no",
        "iterations": some.iterations,
        "planned": max((int(each["planned"]) for each in mine), default=""),
        "unfinished": len(seeds.runs) - len(finals),
        "ci_low": _number(low),
        "ci_high": _number(high),
        "mean_over_run": round(float(np.mean([values.mean() for values in evaluations])), 4),
        **levels,
        "proposal_steps": "" if np.isnan(spent).any() else int(np.mean(spent)),
        "seconds": round(float(np.mean(seconds)), 1) if seconds else "",
        "together": shared,
        "engine": _joined(mine, "engine"),
        "device": _joined(mine, "device"),
        "cpus": _joined(mine, "cpus"),
        "source": "runs.csv",
    }


def published() -> list[dict[str, Any]]:
    """The ends of the published curves."""
    last: dict[tuple[str, str], dict[str, str]] = {}
    for each in read(PAPER_CURVES):
        key = each["task"], each["method"]
        if key not in last or int(each["iteration"]) >= int(last[key]["iteration"]):
            last[key] = each
    return [
        {
            "task": task,
            "preset": "published",
            "method": method,
            "success_mean": float(each["mean"]),
            "success_low": each["low"],
            "success_high": each["high"],
            "seeds": _PUBLISHED_SEEDS,
            "reward": "sparse",
            "iterations": each["iteration"],
            "source": each["source"],
        }
        for (task, method), each in last.items()
    ]


def tabulate(results: Path) -> list[dict[str, Any]]:
    """A row per curve that there are runs of, and per published one; all of the same columns."""
    runs = about(results)
    rows = published()
    for table in sorted(results.glob("curves_*.csv")):
        for seeds in load(table.stem.removeprefix("curves_"), results):
            key = (seeds.curve, seeds.settings, seeds.config)
            one = row(seeds, [each for each in runs if group(each) == key])
            if one is not None:
                rows.append(one)
    methods = style.in_order(each["method"] for each in rows)
    presets = ["published", "paper", "default"]
    tasks = [*TASKS, *sorted({each["task"] for each in rows} - set(TASKS))]
    rows.sort(
        key=lambda r: (
            tasks.index(r["task"]),
            methods.index(r["method"]),
            r["reward"] != "sparse",
            presets.index(r["preset"]),
            r.get("guided") == "yes",
        )
    )
    names = dict.fromkeys([*COLUMNS, *(name for each in sorted(rows, key=len, reverse=True) for name in each)])
    return [{name: each.get(name, "") for name in names} for each in rows]


def _rate(row: Mapping[str, Any], band: bool) -> str:
    """Success with its range, where there is one."""
    rates = [row[name] for name in ("success_mean", "success_low", "success_high")]
    if row["preset"] != "published":  # those are shown as they were read off
        rates = [f"{float(x):.3f}" for x in rates]
    return f"{rates[0]} ({rates[1]} to {rates[2]})" if band and "" not in rates else str(rates[0])


def _millions(row: Mapping[str, Any], level: float) -> str:
    steps, reached = row[f"steps_to_{level:g}"], row[f"reached_{level:g}"]
    if steps != "":
        return f"{float(steps) / 1e6:.1f}"
    return f"{reached} of {row['seeds']}" if int(reached) else "-"


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """For a page: ours beside the published success of the same task and method.

    Args:
        rows: of ``results.csv``.
    """
    theirs = {(r["task"], r["method"]): r for r in rows if r["preset"] == "published"}
    header = ["task", "method", "guided", "published", "success", "mean action", *(f"M steps to {x:g}" for x in LEVELS)]
    header += ["M steps", "wall clock", "seeds"]
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    ours = [r for r in rows if r["preset"] != "published"]
    have = {(r["task"], r["method"]) for r in ours if r["reward"] == "sparse"}
    for r in rows:
        key, words = (r["task"], r["method"]), [str(r["method"])]
        paper = _rate(theirs[key], band=True) if key in theirs and r["reward"] == "sparse" else ""
        if r["preset"] == "published":
            if key not in have:
                lines.append(f"| {r['task']} | {r['method']} | | {paper} | not run |{' |' * (len(header) - 5)}")
            continue
        words += [f"{name}={r[name]}" for name, usual in (("reward", "sparse"), ("preset", "default"))
                  if r[name] != usual]  # fmt: skip
        words += [str(r["settings"])] if r["settings"] else []
        if r["present_defaults"] == "no" and not r["settings"]:
            words.append("(earlier defaults)")
        mean = r["mean_policy_success"]
        cells = [r["task"], " ".join(words), r.get("guided", ""), paper, _rate(r, band=int(r["seeds"]) > 1)]
        cells += [f"{float(mean):.3f}" if mean != "" else ""]
        cells += [_millions(r, level) for level in LEVELS]
        steps = f"{float(r['env_steps']) / 1e6:.1f}"
        if int(r["iterations"]) < int(r["planned"] or 0):
            steps += f" of {float(r['env_steps']) / 1e6 * int(r['planned']) / int(r['iterations']):.1f}"
        minutes = f"{float(r['seconds']) / 60:.1f} min" if r["seconds"] else ""
        cells += [steps, minutes + (f" for {r['together']} together" if r["together"] not in ("", "1") else "")]
        lines.append(f"| {' | '.join(map(str, [*cells, r['seeds']]))} |")
    return "\n".join(lines)


def headline(rows: Sequence[Mapping[str, Any]]) -> str:
    """For the first page: the methods of figure 2 from the goal state alone, our defaults beside the paper's."""
    lines = [
        "| task | method | our defaults | M steps, seeds | `preset=paper` | M steps, seeds | published |",
        "|" + "---|" * 7,
    ]
    for task in TASKS:
        for method in ("reverse", "all_starts", "uniform"):
            cells = []
            for preset in ("default", "paper"):
                found = [
                    r
                    for r in rows
                    if (r["task"], r["method"], r["preset"], r["reward"]) == (task, method, preset, "sparse")
                    and r.get("guided") != "yes"
                    and not r["settings"]
                ]
                if found:
                    r = found[0]
                    old = " (earlier defaults)" if r["present_defaults"] == "no" else ""
                    cells += [
                        _rate(r, band=int(r["seeds"]) > 1) + old,
                        f"{float(r['env_steps']) / 1e6:.0f}, {r['seeds']}",
                    ]
                else:
                    cells += ["", ""]
            theirs = [r for r in rows if (r["task"], r["method"], r["preset"]) == (task, method, "published")]
            lines.append(f"| {' | '.join([task, method, *cells, _rate(theirs[0], band=True) if theirs else ''])} |")
    return "\n".join(lines)


def write(results: Path) -> list[dict[str, Any]]:
    """Writes ``results.csv``; returns its rows, none where there are no runs."""
    rows = tabulate(results)
    if all(each["preset"] == "published" for each in rows):
        return []
    write_rows(results / "results.csv", rows)
    return rows


@in_one_line
def main() -> int:
    """Writes and prints the table."""
    results = Path(options(TableOptions, "experiments.paper.results_table").results)
    rows = write(results)
    if not rows:
        print(f"{results}: no runs yet; make reproduce BUDGET=cpu makes them")
        return 0
    print(f"{markdown(rows)}\n\n{CAPTION}\n{results / 'results.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
