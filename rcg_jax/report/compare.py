"""The report that compares runs: their curves together, the settings that differ, the final success."""

from __future__ import annotations

import datetime
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rcg_jax
from rcg_jax.config.compose import show
from rcg_jax.config.settings import ConfigError, flatten
from rcg_jax.io.tables import write_atomically
from rcg_jax.report.data import RunData, curves, duration, large, numbers, percent, read_run, small_curves, thinned
from rcg_jax.report.page import page
from rcg_jax.runs.settings import is_free

#: Settings that are no part of what runs of one group share.
_BESIDE = frozenset({"seed", "iterations"})

#: Settings that say by themselves what a run is.
_TELLING = ("task", "method", "preset")

#: Labels of so many characters are still read at a glance.
_SHORT = 40

#: Groups that the headline names.
_NAMED = 4


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """The seeds' folders that paths stand for: one itself, or the folder above, of a method, for all of its seeds.

    Raises:
        ConfigError: a folder with neither.
    """
    found: list[Path] = []
    for path in paths:
        files = [path / "config.yaml"] if (path / "config.yaml").exists() else path.glob("seed*/config.yaml")
        seeds = sorted((file.parent for file in files), key=lambda seed: (len(seed.name), seed.name))
        if not seeds:
            raise ConfigError(f"run={path}: no run there; a run's folder is <run_dir>/<task>/<method>/seed<k>")
        found += seeds
    return list(dict.fromkeys(found))


def write_comparison(paths: Sequence[Path], out: Path) -> list[str]:
    """Writes the page ``out`` that compares the runs in seeds' folders; returns the labels of its groups.

    Runs that differ in nothing but the seed are one group, with mean and spread.

    Raises:
        ConfigError: a folder without a run, or without a finished iteration.
        OSError: the page cannot be written.
    """
    runs = [read_run(path) for path in paths]
    groups = grouped(runs)
    tasks = ", ".join(dict.fromkeys(run.task for run in runs))
    title = f"{tasks}: {len(runs)} runs compared"
    rows = [_row(label, members) for label, members in groups.items()]
    content = {
        "kind": "comparison",
        "title": title,
        "headline": _headline(rows),
        "detail": "Success on all feasible starts after training, mean over the seeds that are finished. Shaded: from "
        "the lowest to the highest seed; where there is one seed, the 95 % Wilson interval.",
        "differences": _differences(groups),
        "small": small_curves(list(dict.fromkeys(name for run in runs for name in run.metrics))),
        "runs": [
            {"label": label, "method": members[0].method, **_curves(_counted(members))}
            for label, members in groups.items()
        ],
        "table": rows,
        "left_out": [line for run in runs for line in run.damage],
        "about": [
            ["runs", "\n".join(str(run.path.absolute()) for run in runs)],
            ["report written", f"{datetime.datetime.now():%Y-%m-%d %H:%M}"],
            ["version", f"rcg_jax {rcg_jax.__version__}"],
        ],
    }
    write_atomically(out, page(title, content).encode())
    return list(groups)


def _values(run: RunData) -> dict[str, str]:
    return {name: show(value) for name, _, value in flatten(run.config) if not is_free(name) and name not in _BESIDE}


def _differing(values: Sequence[dict[str, str]]) -> list[str]:
    return [name for name in values[0] if len({each[name] for each in values}) > 1]


def grouped(runs: Sequence[RunData]) -> dict[str, list[RunData]]:
    """Runs by what distinguishes them, each group with a short label; seeds of one setting together.

    The label is of task, method and preset where these tell the groups apart, else of the settings that differ if they
    are few, else a letter; :func:`_differences` says what it stands for.
    """
    values = [_values(run) for run in runs]
    differ = _differing(values)
    kinds: dict[tuple[str, ...], list[RunData]] = {}
    for run, each in zip(runs, values):
        kinds.setdefault(tuple(each[name] for name in differ), []).append(run)
    groups: dict[str, list[RunData]] = {}
    for label, members in zip(_labels(differ, kinds), kinds.values(), strict=True):
        if len({run.config.seed for run in members}) == len(members):
            groups[label] = members
            continue
        # The same seed of the same settings twice: separate runs, told apart by their folders.
        above = os.path.commonpath([run.path.absolute() for run in members])
        groups.update({f"{label}, {os.path.relpath(run.path, above)}": [run] for run in members})
    return groups


def _labels(differ: Sequence[str], kinds: dict[tuple[str, ...], list[RunData]]) -> list[str]:
    """Labels, all different, of groups by their values of the settings that differ."""
    first = [members[0] for members in kinds.values()]
    if not differ:
        return [f"{run.task}, {run.method}" for run in first]
    words, spelled = [], []
    for key, run in zip(kinds, first):
        values = dict(zip(differ, key)) | {"task": run.task, "method": run.method}
        telling = [values[name] for name in _TELLING if name in differ]
        others = [f"{name}={values[name]}" for name in differ if name not in _TELLING]
        words.append(", ".join(telling))
        spelled.append(", ".join(telling + others))
    if len(set(words)) == len(kinds):
        return words
    if max(map(len, spelled)) <= _SHORT and len(set(spelled)) == len(kinds):
        return spelled
    letters = [chr(ord("A") + k) if k < 26 else str(k + 1) for k in range(len(kinds))]
    return [f"{letter} ({each})" if each else letter for letter, each in zip(letters, words)]


def _differences(groups: dict[str, list[RunData]]) -> dict[str, Any]:
    """The settings in which the groups differ, as a table."""
    values = [_values(members[0]) | {"iterations": str(_target(members))} for members in groups.values()]
    names = _differing(values)
    return {"names": names, "rows": [[label, *(each[name] for name in names)] for label, each in zip(groups, values)]}


def _target(members: Sequence[RunData]) -> int:
    """Iterations that a group's seeds have to do."""
    return max(run.config.iterations for run in members)


def _counted(members: Sequence[RunData]) -> list[RunData]:
    """The seeds whose results count: those that are finished, or all if none is."""
    finished = [run for run in members if run.iterations >= _target(members)]
    return finished or list(members)


def _row(label: str, members: Sequence[RunData]) -> dict[str, Any]:
    """A group's final success: each seed's, mean and standard deviation, of the seeds that count."""
    target, counted = _target(members), _counted(members)
    not_done = {run.config.seed: run.iterations for run in members if run.iterations < target}
    unfinished = ""
    if not_done:
        least, most = min(not_done.values()), max(not_done.values())
        span = f"{least}" if least == most else f"{least} to {most}"
        unfinished = f"{len(not_done)} of {len(members)} unfinished ({span} of {target} iterations)"
    finals = [{name: float(each[-1]) for name, each in run.evaluations.items()} for run in counted if run.evaluations]
    rates = [each["success_stochastic"] for each in finals]
    return {
        "label": label,
        "task": members[0].task,
        "unfinished": unfinished,
        "not_done": list(not_done),
        "seeds": [run.config.seed for run in counted],
        "rates": rates,
        "intervals": [[each["success_stochastic_low"], each["success_stochastic_high"]] for each in finals],
        "mean": float(np.mean(rates)) if rates else None,
        "deviation": float(np.std(rates, ddof=1)) if len(rates) > 1 else None,
        "mean_action": float(np.mean([each["success_mean"] for each in finals])) if finals else None,
        "steps": large(float(np.mean([run.metrics["env_steps"][-1] for run in counted]))),
        "time": duration(float(np.mean([run.wall_s for run in counted]))),
    }


def _headline(rows: Sequence[dict[str, Any]]) -> str:
    """The groups by success, those without a finished seed last.

    Those of several tasks are in their order, as success on one says nothing about another's.
    """
    known = [row for row in rows if row["mean"] is not None]
    if not known:
        return "No run was evaluated yet"
    if len({row["task"] for row in rows}) == 1:
        known.sort(key=lambda row: (row["not_done"] == row["seeds"], -row["mean"]))
    words = []
    for row in known[:_NAMED]:
        count, not_done = len(row["rates"]), len(row["not_done"])
        seeds = f"{count} seed{'s' * (count > 1)}"
        if row["seeds"] == row["not_done"]:  # none is finished: those that are shown are unfinished
            seeds += ", unfinished"
        elif not_done:
            seeds += f", {not_done} more unfinished"
        words.append(f"{row['label']} {percent(row['mean'])} ({seeds})")
    if len(known) > _NAMED:
        words.append(f"{len(known) - _NAMED} more below")
    return " · ".join(words)


def _curves(members: Sequence[RunData]) -> dict[str, Any]:
    """A group's curves: the mean of its seeds, lowest and highest, at the steps that all of them have."""
    if len(members) == 1:
        return curves(members[0])
    return {
        "metrics": _together([run.metrics for run in members], thin=True),
        "evaluations": _together([run.evaluations for run in members], thin=False),
        "seeds": [{"seed": run.config.seed, "evaluations": curves(run)["evaluations"]} for run in members],
    }


def _together(tables: Sequence[dict[str, np.ndarray]], *, thin: bool) -> dict[str, list[float | None]]:
    tables = [table for table in tables if table]
    if not tables:
        return {}
    common = sorted(set.intersection(*(set(table["env_steps"].tolist()) for table in tables)))
    # A step may be evaluated twice, at the end of a run that went on later: the last one counts.
    rows = [np.searchsorted(table["env_steps"], common, side="right") - 1 for table in tables]
    chosen = thinned(len(common)) if thin else slice(None)
    columns: dict[str, list[float | None]] = {}
    for name in tables[0]:
        if name.endswith(("_low", "_high")) or not all(name in table for table in tables):
            continue  # of several seeds the spread is shown, not each one's interval
        each = np.stack([table[name][one][chosen] for table, one in zip(tables, rows)])
        columns[name] = numbers(each.mean(axis=0))
        if name in ("success", "success_stochastic"):
            columns[f"{name}_low"], columns[f"{name}_high"] = numbers(each.min(axis=0)), numbers(each.max(axis=0))
    return columns
