"""All runs behind the paper's curves, from one command that can be stopped and given again.

    python -m experiments.paper.reproduce budget=cpu                   # trains what is missing, then collects it
    python -m experiments.paper.reproduce budget=cpu plan=table        # what is missing, how long it takes
    python -m experiments.paper.reproduce budget=cpu plan=commands     # the missing runs, one command a line
    python -m experiments.paper.reproduce task=ring_peg method=reverse,uniform seed=0,1

Finished runs are skipped, broken ones go on at their last checkpoint, one that fails does not stop the others. Two of
these commands on one file system share the work: a run that another process is training is left to it.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiments.common import RESULTS, in_one_line, options, read
from experiments.paper import provenance
from experiments.paper.collect import collect
from experiments.paper.plan import BUDGETS, CURVES, SEEDS, Member, members
from rcg_jax.config.names import METHODS, TASKS
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.io.tables import read_csv
from rcg_jax.runs.folder import FolderInUseError, RunFolder
from rcg_jax.runs.progress import duration
from rcg_jax.runs.recorder import has_evaluation
from rcg_jax.tasks.training import training_config


@dataclass(frozen=True)
class ReproduceOptions:
    """Settings of ``python -m experiments.paper.reproduce``."""

    budget: str = option("cpu", "machine that the runs are meant for", choices=tuple(BUDGETS))
    plan: str = option(
        "no", "no: train; table: what is missing; commands: print them", choices=("no", "table", "commands")
    )
    task: str = option("all", "tasks, separated by commas")
    method: str = option("all", "methods, separated by commas")
    reward: str = option("all", "sparse or distance", choices=("all", "sparse", "distance"))
    preset: str = option("all", "default or paper", choices=("all", "default", "paper"))
    seed: str = option(",".join(map(str, SEEDS)), "seeds, separated by commas")
    together: str = option(
        "budget", "whether the seeds of a curve are one vmapped program", choices=("budget", "yes", "no")
    )
    settings: str = option(
        "none", "further settings of every run, separated by spaces, or none; give such runs a run_dir of their own"
    )
    run_dir: str = option("runs/reproduce", "folder of the runs")
    out: str = option(str(RESULTS), "folder of the CSV files that are collected at the end")


def _names(field: str, text: str, allowed: Sequence[str]) -> Sequence[str]:
    names = allowed if text == "all" else text.split(",")
    for name in names:
        if name not in allowed:
            raise ConfigError(f"{field}={text}: {name} is none of {', '.join(allowed)}")
    return names


def plan_of(chosen: ReproduceOptions) -> list[Member]:
    """The runs asked for.

    Raises:
        ConfigError: an unknown name, no seed, or no curve is left.
    """
    tasks, methods = _names("task", chosen.task, TASKS), _names("method", chosen.method, METHODS)
    if not all(word.isdecimal() for word in chosen.seed.split(",")):
        raise ConfigError(f"seed={chosen.seed}: must be numbers >= 0, separated by commas")
    seeds = sorted({int(word) for word in chosen.seed.split(",")})
    curves = [
        curve
        for curve in CURVES
        if curve.task in tasks
        and curve.method in methods
        and chosen.reward in ("all", curve.reward)
        and chosen.preset in ("all", curve.preset)
    ]
    if not curves:
        raise ConfigError(f"task={chosen.task} method={chosen.method}: the figures need no such curve")
    budget = BUDGETS[chosen.budget]
    if chosen.together != "budget":
        budget = replace(budget, together=chosen.together == "yes")
    if budget.together and seeds != list(range(seeds[0], seeds[0] + len(seeds))):
        raise ConfigError(f"seed={chosen.seed}: seeds of one program must be consecutive; or together=no")
    extra = [] if chosen.settings == "none" else chosen.settings.split()
    return members(budget, curves, seeds, Path(chosen.run_dir) / chosen.budget, extra)


def done(member: Member) -> tuple[int, int, bool]:
    """Iterations done of those planned, and whether the run is finished."""
    config = training_config(member.words)
    folders = [RunFolder(config, seed) for seed in member.seeds]
    rows = [read_csv(folder.metrics_file)[1] for folder in folders]
    at = min(int(cells[-1][0]) if cells else 0 for cells in rows)
    episodes = config.evaluation.final_episodes
    finished = at >= config.iterations and all(has_evaluation(folder, at, episodes) for folder in folders)
    return at, config.iterations, finished


def seconds_per_iteration(member: Member, results: Path) -> float | None:
    """Mean over the rows of ``runs.csv`` of its task and preset; None where there is none."""
    path = results / "runs.csv"
    rows = [
        float(row["seconds"]) / int(row["iterations"])
        for row in (read(path) if path.exists() else [])
        if (row["task"], row["preset"]) == (member.curve.task, member.curve.preset) and row["seconds"]
    ]
    return sum(rows) / len(rows) if rows else None


def table(plan: Sequence[Member], results: Path) -> str:
    """A line per run: how far it is and how long the rest takes; and the sum."""
    lines, total, finished = [], 0.0, 0
    for member in plan:
        at, planned, is_done = done(member)
        each = seconds_per_iteration(member, results)
        left = None if each is None else each * (planned - at)
        finished += is_done
        total += left or 0.0
        words = "finished" if is_done else f"{at} of {planned}, {'?' if left is None else duration(left)} left"
        lines.append(f"{member.curve!s:<44} seeds {','.join(map(str, member.seeds)):<10} {words}")
    return "\n".join([*lines, f"{finished} of {len(plan)} runs finished, about {duration(total)} left on 2 CPU cores"])


def _busy(folder: RunFolder) -> bool:
    """Whether another process writes to a seed's folder."""
    if not folder.path.is_dir():
        return False
    try:
        folder.open()
    except FolderInUseError:
        return True
    folder.close()
    return False


def _end(process: subprocess.Popen[bytes]) -> None:
    """Tells a run to save and end, and waits for it; told again, it ends at once."""
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait()
        except KeyboardInterrupt:
            continue


def _stop(signum: int, frame: Any) -> None:
    raise KeyboardInterrupt


def train(plan: Sequence[Member], results: Path) -> list[Member]:
    """Trains what is not finished; returns the runs that failed.

    Raises:
        KeyboardInterrupt: stopped; the run under way is saved.
    """
    failed = []
    for number, member in enumerate(plan, start=1):
        at, planned, is_done = done(member)
        if is_done:
            continue
        each = seconds_per_iteration(member, results)
        about = "" if each is None else f", about {duration(each * (planned - at))}"
        print(f"\n[{number}/{len(plan)}] {member.shown}{about}", flush=True)
        config = training_config(member.words)
        folders = [RunFolder(config, seed) for seed in member.seeds]
        if any(map(_busy, folders)):
            print("another process trains it", flush=True)
            continue
        made_with = provenance.describe(len(member.seeds), on_cpu=config.engine == "native")
        process = subprocess.Popen(member.command, start_new_session=True)  # hears of Ctrl-C from here, once
        try:
            code = process.wait()
        except KeyboardInterrupt:
            _end(process)
            raise
        finally:
            if done(member)[0] > at:
                provenance.record([folder.path for folder in folders], made_with, at)
        if code:
            failed.append(member)
    return failed


@in_one_line
def main() -> int:
    """Trains or shows the plan; returns the exit code."""
    chosen = options(ReproduceOptions, "experiments.paper.reproduce")
    plan, results = plan_of(chosen), Path(chosen.out)
    if chosen.plan == "table":
        print(table(plan, results))
        return 0
    if chosen.plan == "commands":
        print("\n".join(member.shown for member in plan if not done(member)[2]))
        return 0
    for signum in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, _stop)
    try:
        failed = train(plan, results)
    except KeyboardInterrupt:
        print("\nstopped; the same command goes on", file=sys.stderr)
        collect(Path(chosen.run_dir) / chosen.budget, results)
        return 130
    collect(Path(chosen.run_dir) / chosen.budget, results)
    for member in failed:
        print(f"failed: {member.shown}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
