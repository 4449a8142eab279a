"""Generates a task's feasible starts S^0 (appendix A.2): ``python -m rcg_jax.feasible task=ring_peg``.

When to stop is the one free choice: S^0 has far more cells than walks ever visit, and the share of starts on the peg
falls as walks get further (``search.growth`` in the card). The paper does not give its M, but for the ring the outcome:
39,530 starts, 14.3 % of them on the peg. The default stops just beyond that number; the shipped search then has 9.2 %
on the peg, so that rho_0 is no easier than the paper's.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rcg_jax.config.arguments import describe_arguments, parse_arguments
from rcg_jax.config.class_path import resolve_name
from rcg_jax.config.search import FeasibleConfig
from rcg_jax.config.settings import ConfigError
from rcg_jax.evaluate.stats import bin_width
from rcg_jax.io.console import lenient_output, tell
from rcg_jax.io.starts_file import encode_starts, hash_starts
from rcg_jax.runs.progress import duration

if TYPE_CHECKING:
    from rcg_jax.tasks.base import Task

#: Width of the distance histogram's bins [m], at least.
BIN = 0.05

#: A search ends after this many rounds in a row without a new start.
PATIENCE = 3

#: Settings of a search's rounds (:func:`rcg_jax.curriculum.feasible.search`).
_WALKS = ("seed", "seeds", "num_walks", "walk_length", "noise", "noise_std")
_CHECKS = ("grid", "max_depth", "max_excess", "max_drift", "settle_steps")


def usage() -> str:
    """The help text."""
    settings = describe_arguments(FeasibleConfig, "rcg_jax.feasible").partition("\n\n")[2]
    return f"""usage: python -m rcg_jax.feasible [name=value ...]

Generates the feasible starts of a task as the paper does: walks begin in states drawn uniformly from all that were
collected so far, at first the goal state; the collected states are thinned to one per grid cell; each start is checked
for overlap and for staying where it is. A task may have defaults of its own for these settings; where it can sample its
feasible starts exactly, that is done instead.

{settings}"""


@dataclass(frozen=True)
class Result:
    """A finished search.

    Attributes:
        qpos: (C, nq) float32 starts.
        stopped: why the search ended.
        search: its numbers, for the card; of more ``found`` starts, ``qpos`` is a uniformly random subset.
        act: (C, na) float32 their activations; None where the model has none.
    """

    qpos: np.ndarray
    stopped: str
    search: dict[str, Any]
    act: np.ndarray | None = None


def generate(task: Task, config: FeasibleConfig, say: Callable[[str], None]) -> Result:
    """Searches until there are ``config.num_found`` starts, no new ones, or ``config.max_rounds`` is reached.

    Raises:
        ConfigError: the checks are too strict for the task's goal state.
    """
    import jax

    from rcg_jax.curriculum.feasible import make_compositions, search

    if task.has_exact_sampler():
        say(f"{task.name}: drawn from its exact sampler; only num_states and seed count")
        drawn = task.sample_feasible(jax.random.key(config.seed), config.num_states)
        act = None if drawn.act is None else np.asarray(drawn.act)
        return Result(qpos=np.asarray(drawn.qpos), stopped="num_states", search={"exact_sampler": True}, act=act)
    begin = time.monotonic()
    enough = max(config.num_found, config.num_states)
    compose = make_compositions(task)
    counts: dict[str, int] = {}
    growth: list[dict[str, float]] = []
    idle = 0
    rounds = search(task, **{name: getattr(config, name) for name in (*_WALKS, *_CHECKS)})
    for number, last in enumerate(rounds, start=1):
        total = len(last.rows)
        fresh, _ = compose(last.rows[total - last.fresh :])
        counts = {name: counts.get(name, 0) + int(is_in.sum()) for name, is_in in fresh.items()}
        shares = {name: round(count / max(total, 1), 4) for name, count in counts.items()}
        idle = 0 if last.fresh else idle + 1
        stopped = ""
        if total >= enough:
            stopped = "num_found" if enough > config.num_states else "num_states"
        elif number == config.max_rounds:
            stopped = "max_rounds"
        elif idle == PATIENCE:
            stopped = "saturated"
        if stopped or number & (number - 1) == 0:  # rounds 1, 2, 4, 8, ...
            growth.append({"visited": last.visited, "starts": total, **shares})
        elapsed = time.monotonic() - begin
        share = max(total / enough, number / config.max_rounds)
        parts = "  ".join(f"{name} {value:.3f}" for name, value in shares.items())
        left = "" if stopped else f"  ETA {duration(elapsed * (1 - share) / share)}"
        say(f"round {number}: {total:,} of {enough:,} starts, {last.visited:,} states visited  {parts}{left}")
        if stopped:
            break
    rows, nq = last.rows, task.model.nq
    if total > config.num_states:  # a fair sample: the last found are the furthest
        chosen = np.random.default_rng(config.seed).choice(total, config.num_states, replace=False)
        rows = rows[np.sort(chosen)]
    act = rows[:, nq:] if task.model.na else None
    numbers = {"found": total, "visited": last.visited, "walks": last.walks, "rejected": last.rejected}
    return Result(qpos=rows[:, :nq], stopped=stopped, search={**numbers, "growth": growth}, act=act)


def describe(task: Task, qpos: np.ndarray, act: np.ndarray | None = None) -> dict[str, Any]:
    """What a set of starts (C, nq), with activations (C, na), contains: hash, count, composition, distances."""
    from rcg_jax.curriculum.feasible import make_compositions

    subsets, distance = make_compositions(task)(qpos if act is None else np.hstack([qpos, act]))
    width = bin_width(float(distance.max()), BIN)
    edges = np.arange(np.ceil(distance.max() / width) + 1) * width
    histogram, _ = np.histogram(distance, edges)
    return {
        "task": task.name,
        "sha256": hash_starts(qpos, act),
        "count": len(qpos),
        "composition": {
            name: {"count": int(is_in.sum()), "share": round(float(is_in.mean()), 4)} for name, is_in in subsets.items()
        },
        "mean_distance_m": round(float(distance.mean()), 4),
        "distance_histogram": {"bin_m": width, "counts": histogram.tolist()},
    }


def card(task: Task, config: FeasibleConfig, result: Result) -> dict[str, Any]:
    """What a file of starts contains and how it was made, for the JSON beside it."""
    import jax
    import mujoco

    from rcg_jax.tasks.check import search_words

    defaults = parse_arguments(FeasibleConfig, search_words(task))
    settings = {name: value for name, value in dataclasses.asdict(config).items() if name not in ("out", "overwrite")}
    if task.has_exact_sampler():  # nothing else counts
        settings = {name: settings[name] for name in ("task", "seed", "num_states")}
    shown = {name: value for name, value in settings.items() if name == "task" or value != getattr(defaults, name)}
    return {
        **describe(task, result.qpos, result.act),
        "command": " ".join(["python -m rcg_jax.feasible", *(f"{name}={value}" for name, value in shown.items())]),
        "settings": settings,
        "stopped_by": result.stopped,
        "search": result.search,
        "versions": {"jax": jax.__version__, "mujoco": mujoco.__version__, "numpy": np.__version__},
    }


def check_output(out: Path, config: FeasibleConfig) -> None:
    """Raises a ConfigError where ``out`` and its card cannot be written, or exist and must not be replaced."""
    if out.suffix != ".npz":
        raise ConfigError(f"out={out}: must end in .npz")
    for path in (out, out.with_suffix(".json")):
        if path.is_dir():
            raise ConfigError(f"out={out}: {path} is a folder")
        if path.exists() and config.overwrite == "false":
            raise ConfigError(f"out={out}: {path} exists; overwrite=true replaces it, out=... writes elsewhere")
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ConfigError(f"out={out}: {folder} is no folder that can be written to")


def run(words: Sequence[str], say: Callable[[str], None]) -> None:
    """Generates and writes a file of starts and its card, with settings as on the command line.

    Raises:
        ConfigError: a setting that cannot be used.
        OSError: the files cannot be written; existing ones are as before.
    """
    name = parse_arguments(FeasibleConfig, words).task
    resolve_name("task", name)  # a wrong one is refused before JAX is imported
    from rcg_jax.io.tables import write_atomically
    from rcg_jax.tasks import make_task, task_class
    from rcg_jax.tasks.check import check_search, check_task, search_words
    from rcg_jax.tasks.training import task_settings

    cls = task_class(name)
    check_search(cls)
    config = parse_arguments(FeasibleConfig, [*search_words(cls), *words])
    out = Path(config.out) if config.out else cls.feasible_file
    check_output(out, config)
    try:
        task = make_task(name, config.engine)
    except RuntimeError as error:  # engine=native on an accelerator
        raise ConfigError(str(error)) from None
    check_task(task, starts=False)
    task_settings(cls)  # a search may take long: what a run would refuse of it is refused now
    result = generate(task, config, say)
    if not len(result.qpos):
        raise ConfigError("no feasible start found; give longer walks, more rounds or weaker checks")
    shown = card(task, config, result)
    if shown["composition"].get("at_goal", {}).get("count") == len(result.qpos):
        raise ConfigError(
            f"is_goal: holds in all of the {len(result.qpos):,} starts found; give longer walks, or a smaller goal set"
        )
    text = json.dumps(shown, indent=2) + "\n"
    check_output(out, config)  # another process may have finished meanwhile
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, encode_starts(result.qpos, result.act))
    write_atomically(out.with_suffix(".json"), text.encode())
    say(f"{out}: {len(result.qpos):,} starts, {out.stat().st_size / 1e6:.2f} MB; {out.with_suffix('.json')}")


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 2 for a wrong setting, 1 for a file that cannot be written."""
    words = sys.argv[1:] if argv is None else list(argv)
    if "-h" in words or "--help" in words:
        print(usage())
        return 0
    try:
        run(words, lambda line: print(line, flush=True))
    except (ConfigError, OSError) as error:
        tell(error)
        return 2 if isinstance(error, ConfigError) else 1
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
