"""From run folders to the committed CSV files that the figures are drawn from.

    python -m experiments.paper.collect run_dir=runs/reproduce        # every run below that folder

``results/curves_<task>.csv`` has a row per evaluation and per stretch of iterations (about 100 of them a run) of each
run: success on rho_0 where there was an evaluation, and the means of the training metrics over the iterations since the
row before; ``proposal_steps`` is their sum since the beginning. ``results/runs.csv`` has a row per run: how it ended,
what it took, its command, machine and commit. A run is known by task, method, reward, preset, seed, ``settings``, in
which it differs from the present defaults of its preset, and ``config``, a digest of all settings that touch what is
learned: rows of earlier defaults stay apart from those of the present ones. What is collected replaces the rows of the
same run, unless those are of more environment steps; rows of other runs stay. Machine and commit are those that
``experiments.paper.reproduce`` wrote into the folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import RESULTS, commit, in_one_line, locked, options, read, require, write_rows
from experiments.paper import provenance
from experiments.paper.plan import GUIDED
from rcg_jax.config.class_path import class_name
from rcg_jax.config.compose import compose_config
from rcg_jax.config.settings import Config, ConfigError, flatten, option
from rcg_jax.io.tables import read_csv
from rcg_jax.physics.variants import SCALES
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.settings import is_free, read_config
from rcg_jax.tasks import task_class
from rcg_jax.tasks.training import resolve

#: What a run is known by, within its task.
KEY = ("method", "reward", "preset", "seed", "settings", "config")

#: Training metrics of a row: means over its stretch of iterations.
METRICS = ("success_rho_i", "share_low", "share_good", "share_high", "labelled", "start_distance")

#: Rows of a run beside its evaluations.
STRETCHES = 100

#: Settings that have columns of their own, or do not touch what is learned.
_NAMED = ("task", "method", "reward", "preset", "seed", "engine")

Row = dict[str, Any]


@dataclass(frozen=True)
class CollectOptions:
    """Settings of ``python -m experiments.paper.collect``."""

    run_dir: str = option("runs/reproduce", "folder of runs, at any depth")
    out: str = option(str(RESULTS), "folder of the CSV files")
    commit: str = option("unknown", "commit of runs whose folder does not say it; here: this checkout's")
    force: str = option("no", "whether runs of fewer steps may replace longer ones", choices=("no", "yes"))


@cache
def defaults(preset: str, task: str) -> dict[str, Any]:
    """What a preset trains a task with, by name; a class that cannot be found any more asks for nothing."""
    config = compose_config([f"preset={preset}"])
    horizon = 500
    with contextlib.suppress(ConfigError, ValueError):
        config, _ = resolve(dataclasses.replace(config, task=task), ())
        horizon = task_class(task).horizon
    return {name: value for name, _, value in flatten(with_sizes(config, horizon))}


def changed(config: Config) -> list[str]:
    """Settings in which a run differs from its preset, without those that are columns or free: ``name=value``."""
    default = defaults(config.preset, config.task)
    return [
        f"{name}={_text(value)}"
        for name, _, value in flatten(config)
        if name not in _NAMED and not is_free(name) and value != default[name]
    ]


def digest(values: Mapping[str, Any]) -> str:
    """8 hex digits of all resolved settings, by dotted name, that touch what is learned and have no column.

    Settings that are younger than the first rows are left out where they do what was done before them.
    """
    unused: tuple[str, ...] = ()
    if values.get("algorithm", "trpo") == "trpo":
        unused += ("algorithm", "ppo.")
    if not any(values.get(f"randomize.{name}") for name in SCALES):
        unused += ("randomize.",)
    kept = {
        name: value
        for name, value in sorted(values.items())
        if name not in _NAMED and not is_free(name) and not name.startswith(unused)
    }
    return hashlib.sha256(json.dumps(kept).encode()).hexdigest()[:8]


@cache
def present(preset: str, task: str, guided: bool = False) -> str:
    """The digest of a preset's present values on a task; ``guided``: with :data:`experiments.paper.plan.GUIDED`."""
    name, _, share = GUIDED.partition("=")
    return digest(defaults(preset, task) | ({name: float(share)} if guided else {}))


def _text(value: Any) -> str:
    return str(value).replace(" ", "").lower() if isinstance(value, list | bool) else str(value)


def command(config: Config, settings: Sequence[str]) -> str:
    """What repeats a run."""
    default = Config()
    words = [f"{name}={getattr(config, name)}" for name in ("task", "method", "engine", "seed", "iterations")]
    words += [
        f"{name}={getattr(config, name)}"
        for name in ("reward", "preset", "eval_every")
        if getattr(config, name) != getattr(default, name)
    ]
    return " ".join(["python -m rcg_jax.run", *words, *settings])


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file of a run by name; text and empty cells are NaN."""

    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            return math.nan

    header, rows = read_csv(path)
    return {name: np.array([number(row[i]) for row in rows]) for i, name in enumerate(header)}


def _round(value: float) -> float | str:
    return "" if math.isnan(value) else float(f"{value:.6g}")


def curve_rows(run: Path, first: Row) -> list[Row]:
    """Rows of ``curves_<task>.csv`` of one run.

    Args:
        run: a seed's folder.
        first: cells that all of them begin with.
    """
    log, evals = _columns(run / "metrics.csv"), _columns(run / "eval.csv")
    if not log or not len(log["iteration"]):
        return []
    at = log["iteration"].astype(int)
    last, stride = int(at[-1]), max(1, math.ceil(len(at) / STRETCHES))
    evaluated: dict[int, int] = {}
    for k, i in enumerate(evals["iteration"].astype(int) if evals else []):
        if i not in evaluated or evals["episodes"][k] >= evals["episodes"][evaluated[i]]:
            evaluated[int(i)] = k
    # Where no start had enough episodes, the shares of kinds say nothing.
    unknown = log["labelled"] == 0 if "labelled" in log else np.zeros(len(at), bool)
    for name in ("share_low", "share_good", "share_high"):
        log[name] = np.where(unknown, math.nan, log.get(name, math.nan))
    log["success_rho_i"] = log.get("success", np.full(len(at), math.nan))
    spent = np.nancumsum(log.get("proposal_steps", np.zeros(len(at))))
    rows, before = [], 0
    for i in map(int, sorted({*range(stride, last + 1, stride), *evaluated, last})):
        here = (at > before) & (at <= i)
        if not here.any():
            continue
        before, end = i, int(np.flatnonzero(here)[-1])
        row: Row = {**first, "iteration": i, "env_steps": int(log["env_steps"][end])}
        found = evaluated.get(i)
        for name, source in (
            ("success_stochastic", "success_stochastic"),
            ("success_mean", "success_mean"),
            ("eval_episodes", "episodes"),
        ):
            row[name] = "" if found is None else _round(float(evals[source][found]))
        row["eval_episodes"] = "" if found is None else int(evals["episodes"][found])
        for name in METRICS:
            cells = log.get(name, np.full(len(at), math.nan))[here]
            row[name] = _round(float(np.nanmean(cells)) if not np.isnan(cells).all() else math.nan)
        row["proposal_steps"] = int(spent[end])
        rows.append(row)
    return rows


def run_row(run: Path, config: Config, key: Row, rows: Sequence[Row], default_commit: str) -> Row:
    """A run's row of ``runs.csv``."""
    log, evals = read_csv(run / "metrics.csv"), read_csv(run / "eval.csv")
    wall = float(dict(zip(log[0], log[1][-1])).get("wall_s", 0.0))
    starts = dict(zip(evals[0], evals[1][-1])).get("starts_sha256", "") if evals[1] else ""
    final = next((row for row in reversed(rows) if row["success_stochastic"] != ""), None)
    about = provenance.combined(run)
    about["commit"] = about["commit"] or default_commit
    return {
        "task": class_name(config.task),
        **key,
        "iterations": rows[-1]["iteration"],
        "planned": config.iterations,
        "env_steps": rows[-1]["env_steps"],
        **{name: "" if final is None else final[name] for name in ("success_stochastic", "success_mean")},
        "eval_episodes": "" if final is None else final["eval_episodes"],
        "proposal_steps": rows[-1]["proposal_steps"],
        "seconds": round(wall, 1),
        "ended": datetime.fromtimestamp((run / "metrics.csv").stat().st_mtime, UTC).strftime("%Y-%m-%dT%H:%M"),
        "engine": config.engine,
        "starts_sha256": starts,
        **about,
        "command": command(config, list(filter(None, key["settings"].split(" ")))),
    }


def key_of(row: Row) -> tuple[str, ...]:
    """What a row's run is known by."""
    # Rows of before there was a digest are of unknown settings.
    return tuple(str(row.get(name, "") if name == "config" else row[name]) for name in KEY)


def _by_run(rows: Iterable[Row]) -> dict[tuple[str, ...], list[Row]]:
    out: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        out.setdefault(key_of(row), []).append(row)
    return out


def find(run_dir: Path, default_commit: str = "") -> dict[str, dict[tuple[str, ...], tuple[Row, list[Row]]]]:
    """All runs below a folder: task -> key -> (row of ``runs.csv``, rows of ``curves_<task>.csv``).

    Of two runs of one key, the one of more environment steps counts.

    What cannot be read is left out, with a line on the error stream.
    """
    out: dict[str, dict[tuple[str, ...], tuple[Row, list[Row]]]] = {}
    for path in sorted(run_dir.rglob("seed*/config.yaml")):
        run = path.parent
        try:
            config = read_config(run)
            key: Row = {"method": class_name(config.method), "reward": config.reward, "preset": config.preset}
            values = {name: value for name, _, value in flatten(config)}
            key |= {"seed": config.seed, "settings": " ".join(changed(config)), "config": digest(values)}
            rows = curve_rows(run, key)
        except (ConfigError, ValueError, KeyError) as error:
            print(f"warning: {run} is left out: {' '.join(str(error).split())}", file=sys.stderr)
            continue
        if not rows:
            continue
        found = out.setdefault(class_name(config.task), {})
        have = found.get(key_of(key))
        if have is None or have[1][-1]["env_steps"] < rows[-1]["env_steps"]:
            found[key_of(key)] = run_row(run, config, key, rows, default_commit), rows
    return out


def collect(run_dir: Path, out: Path, *, default_commit: str = "", force: bool = False) -> int:
    """Writes the CSV files; returns the number of runs that were found."""
    found = find(run_dir, default_commit)
    if not found:
        return 0
    with locked(out):
        return _merge(found, run_dir, out, force)


def _merge(
    found: dict[str, dict[tuple[str, ...], tuple[Row, list[Row]]]], run_dir: Path, out: Path, force: bool
) -> int:
    """Puts what was found into the CSV files; returns the number of runs."""
    table = out / "runs.csv"
    about = {(row["task"], *key_of(row)): row for row in _known(table, ("task",))}
    count = 0
    for task, runs in sorted(found.items()):
        path = out / f"curves_{task}.csv"
        known = _by_run(_known(path, ("iteration", "env_steps")))
        for key, (row, rows) in runs.items():
            count += 1
            old, new = int(known[key][-1]["env_steps"]) if key in known else 0, rows[-1]["env_steps"]
            if old > new and not force:
                words = " ".join(filter(None, key))
                print(f"{task} {words}: {path.name} has {old:,} steps of it, this run {new:,}; kept (force=yes)")
                continue
            known[key], about[(task, *key)] = rows, row
        write_rows(path, [_keyed(row) for key in sorted(known, key=_order) for row in known[key]])
        print(f"{path}: {len(known)} runs, {len(runs)} of them found in {run_dir}")
    if count:
        rows = [about[key] for key in sorted(about, key=lambda k: (k[0], *_order(k[1:])))]
        write_rows(table, [_keyed({"task": row["task"], **row}) for row in rows])
    return count


def _known(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV file, none where there is none.

    Raises:
        ResultsError: it is damaged, or another program's.
    """
    rows = read(path) if path.exists() else []
    require(path, rows, [*columns, *(name for name in KEY if name != "config")])
    return rows


def _keyed(row: Row) -> Row:
    """A row with all columns of its key, in their order."""
    first = {"task": row["task"]} if "task" in row else {}
    return {**first, **{name: row.get(name, "") for name in KEY}, **row}


def _order(key: tuple[str, ...]) -> tuple[Any, ...]:
    """Seeds by number."""
    return (*key[:3], *key[4:], int(key[3]))


@in_one_line
def main() -> int:
    """Collects; returns the exit code."""
    chosen = options(CollectOptions, "experiments.paper.collect")
    default = {"here": commit(), "unknown": ""}.get(chosen.commit, chosen.commit)
    if not collect(Path(chosen.run_dir), Path(chosen.out), default_commit=default, force=chosen.force == "yes"):
        print(f"error: run_dir={chosen.run_dir}: no runs there; make reproduce BUDGET=cpu makes them", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
