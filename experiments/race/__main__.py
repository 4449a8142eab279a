"""The race: trains this package and its rivals on the same tasks, one after the other, and scores them all alike.

    make race                                            # all that experiments/results/race.csv lacks; hours
    python -m experiments.race tasks=ring_peg trainers=ours,sac_her seeds=1 minutes=30

Every row is a command that starts with an empty compilation cache and may use all cores. Its wall clock counts from the
start of the command: imports, compilation and the trainer's own evaluations included. Policies are saved on the way and
scored afterwards (:mod:`experiments.race.score`). A row that is there is not run again; of one that
was interrupted, training begins anew and scoring goes on.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from experiments.common import RESULTS, ResultsError, commit, cpu_model, in_one_line, options, read, write_rows
from experiments.race.entrants import ENTRANTS
from experiments.race.snapshots import STARTED
from rcg_jax.config.settings import ConfigError, option

#: The Python of the rivals, which ``make race-env`` makes.
RIVALS_PYTHON = Path(".venv-race/bin/python")

#: Success that a task counts as begun, and as solved.
LEVELS = (0.45, 0.9)

#: Columns of a point of a learning curve.
_POINT = ("seconds", "env_steps", "stochastic", "mean")

#: Seconds that a trainer may take to end after its time limit.
GRACE = 120


@dataclass(frozen=True)
class RaceOptions:
    """Settings of ``python -m experiments.race``."""

    tasks: str = option("ring_peg,point_maze,key_insertion", "tasks")
    trainers: str = option("all", f"all, or some of {', '.join(ENTRANTS)}")
    seeds: int = option(2, "seeds 0, 1, ... of each row", low=1)
    minutes: float = option(30.0, "time limit of a row", low=0.01)
    episodes: int = option(2_000, "of each policy and snapshot, for the scores", low=1)
    folder: str = option("runs/race", "where trainers leave their snapshots")
    out: str = option(str(RESULTS / "race.csv"), "file *.csv of the rows; curves go beside it")
    words: str = option("", "more words for the trainers' programs, such as every=20")


@in_one_line
def main() -> int:
    """Runs the rows that are missing."""
    chosen = options(RaceOptions, "experiments.race")
    trainers = list(ENTRANTS) if chosen.trainers == "all" else chosen.trainers.split(",")
    for name in trainers:
        if name not in ENTRANTS:
            raise ConfigError(f"trainers={name}: must be all, or some of {', '.join(ENTRANTS)}")
        if ENTRANTS[name].rival and not RIVALS_PYTHON.exists():
            raise ConfigError(f"trainers={name}: needs {RIVALS_PYTHON}; make race-env makes it")
    out = Path(chosen.out)
    rows = [(task, name, seed) for task in chosen.tasks.split(",") for name in trainers for seed in range(chosen.seeds)]
    missing = [row for row in rows if row not in _there(out)]
    print(
        f"{len(rows)} rows, {len(missing)} to run, at most {len(missing) * chosen.minutes / 60:.1f} hours", flush=True
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the trainer, too
    failed = 0
    for number, (task, name, seed) in enumerate(missing, 1):
        print(f"== {number}/{len(missing)}: {task}, {name}, seed {seed}", flush=True)
        try:
            _run(chosen, task, name, seed, out)
        except ResultsError as error:  # the other rows are run
            print(f"error: {error}", file=sys.stderr, flush=True)
            failed += 1
    return 1 if failed else 0


def _there(out: Path) -> set[tuple[str, str, int]]:
    return {(row["task"], row["trainer"], int(row["seed"])) for row in read(out)} if out.exists() else set()


def _run(chosen: RaceOptions, task: str, name: str, seed: int, out: Path) -> None:
    """One row: train, unless an earlier call did, score, write."""
    entrant, folder = ENTRANTS[name], Path(chosen.folder) / task / name / f"seed{seed}"
    python = str(RIVALS_PYTHON) if entrant.rival else sys.executable
    words = [f"trainer={name}", f"task={task}", f"seed={seed}", f"minutes={chosen.minutes}", f"folder={folder}"]
    command = [python, "-m", entrant.module, *words, *chosen.words.split()]
    trained = folder / "trained"
    if not trained.exists() or trained.read_text() != shlex.join(command):
        _train(command, folder, chosen.minutes)
        trained.write_text(shlex.join(command))
    score = [python, "-m", "experiments.race.score", f"folder={folder}", f"trainer={name}", f"task={task}"]
    subprocess.run([*score, f"episodes={chosen.episodes}"], check=True)
    curve = read(folder / "scores.csv")
    about: dict[str, Any] = {"task": task, "trainer": name, "seed": seed}
    row = {
        **about,
        "version": _version(python, entrant.package),
        "starts": entrant.starts,
        **crossings(curve),
        "success_stochastic": curve[-1]["stochastic"],
        "success_mean": curve[-1]["mean"],
        "minutes": f"{float(curve[-1]['seconds']) / 60:.2f}",
        "env_steps": curve[-1]["env_steps"],
        "limit_minutes": chosen.minutes,
        "episodes": chosen.episodes,
        "threads": len(os.sched_getaffinity(0)),
        "device": cpu_model(),
        "commit": commit(),
        "command": " ".join(["python -m experiments.race", *sys.argv[1:]]),
    }
    _replace(
        out.with_name(f"{out.stem}_curves.csv"),
        about,
        [{**about, **{key: point[key] for key in _POINT}} for point in curve],
    )
    _replace(out, about, [row])  # last: a row that is there has its curve
    print({key: row[key] for key in (*about, *crossings(curve), "success_stochastic", "success_mean")}, flush=True)


def _train(command: Sequence[str], folder: Path, minutes: float) -> None:
    """Runs a trainer in its emptied folder until it ends or its time is over."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str((folder / "cache").resolve()),
        STARTED: str(time.time()),
    }
    with (folder / "log.txt").open("w") as log:
        process = subprocess.Popen(
            command, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(60 * minutes + GRACE)
        except subprocess.TimeoutExpired:
            raise ResultsError(f"{folder / 'log.txt'}: did not end {GRACE} s after its time limit") from None
        finally:
            with contextlib.suppress(ProcessLookupError):  # whatever it has started goes with it
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    shutil.rmtree(folder / "cache", ignore_errors=True)
    if code:
        raise ResultsError(f"{folder / 'log.txt'}: ended with exit code {code}")
    if not any((folder / "snapshots").iterdir()):
        raise ResultsError(f"{folder}: no snapshots")


def crossings(curve: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Minutes and environment steps of the first snapshot at each of :data:`LEVELS`, stochastic; empty: none was."""
    cells = {}
    for level in LEVELS:
        first = next((point for point in curve if float(point["stochastic"]) >= level), None)
        cells[f"minutes_to_{level}"] = f"{float(first['seconds']) / 60:.2f}" if first else ""
        cells[f"steps_to_{level}"] = first["env_steps"] if first else ""
    return cells


def _version(python: str, package: str) -> str:
    if python == sys.executable:
        return version(package)
    code = f"from importlib.metadata import version; print(version({package!r}))"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def _replace(path: Path, about: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes ``rows`` in the place of those that are about the same."""
    old = read(path) if path.exists() else []
    kept = [row for row in old if any(row[key] != str(value) for key, value in about.items())]
    write_rows(path, [*kept, *rows])


if __name__ == "__main__":
    sys.exit(main())
