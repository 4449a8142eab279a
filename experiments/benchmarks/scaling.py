"""How speed, memory and compilation scale: train steps over task x engine x devices x seeds x environments.

    make scaling                                            # ring_peg, what suits this machine
    python -m experiments.benchmarks.scaling tasks=ring_peg,point_maze engines=native,mjx num_envs=100,400,1600
    python -m experiments.benchmarks.scaling devices=1,2 engines=mjx   # on a CPU, it is split into that many devices
    python -m experiments.benchmarks.scaling --help

Each point is a process of its own, compiled without a cache. One that runs out of memory, is killed, or takes too long
is a row with that status, and the sweep goes on; where memory or time ran out, larger points of the same kind are left
out. Points that the CSV has already, from the same commit on the same machine, are skipped unless force=yes. The
picture is drawn from all rows of this machine.

Columns: ``steps_per_s`` counts steps of policy rollouts of all seeds, in the median iteration, which pays for
everything; ``cpu_s`` is the processor time of an iteration over all threads, which other programs on the machine
disturb less than ``iteration_s``; ``planned_gb`` are arguments, results and temporaries by the compiler's account,
``run_gb`` what the iterations added to the process, ``peak_gb`` its peak, compilation included, ``device_gb`` the peak
of an accelerator.
"""

from __future__ import annotations

import itertools
import json
import os
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from experiments.benchmarks import point_process, probe
from experiments.benchmarks.live import Display
from experiments.common import RESULTS, options, read, write_rows
from rcg_jax.config.class_path import resolve_name
from rcg_jax.config.names import ENGINES
from rcg_jax.config.settings import Config, ConfigError, option
from rcg_jax.runs.progress import duration

#: Environments unless set, on a CPU and on an accelerator.
CPU_ENVS, ACCELERATOR_ENVS = "100,400,1600,6400", "1024,4096,16384,65536"

#: Horizons that an environment sees in a curriculum iteration unless ``length`` is set: as in a run with default sizes.
LEAST_EPISODES = 2

#: What became of a point whose like with more environments are not worth trying.
TOO_MUCH = {"out of memory": "ran out of memory", "timed out": "took too long"}

COLUMNS = (
    *("task", "engine", "num_envs", "num_seeds", "devices", "length", "trpo_iterations", "batch_size", "status"),
    *("steps_per_s", "iteration_s", "cpu_s", "rounds", "env_steps", "compile_s"),
    *("planned_gb", "run_gb", "peak_gb", "device_gb", "start_s", "wall_s", "load", "note"),
    *("device", "cpus", "python", "jax", "mujoco", "commit", "command"),
)


@dataclass(frozen=True)
class ScalingOptions:
    """Settings of ``python -m experiments.benchmarks.scaling``; several values are separated by commas."""

    tasks: str = option("ring_peg", "tasks")
    engines: str = option("auto", "engines; auto: native and mjx on a CPU, mjx elsewhere")
    num_envs: str = option("auto", f"environments of each seed; auto: {CPU_ENVS}, on accelerators {ACCELERATOR_ENVS}")
    num_seeds: str = option("1", "seeds in one vmapped program")
    devices: str = option("1", "devices that share the environments")
    length: int = option(0, "steps of an environment in a TRPO iteration; 0: two horizons in all of them", low=0)
    trpo_iterations: int = option(0, "TRPO iterations per curriculum iteration; 0: the default", low=0)
    warmup: int = option(2, "iterations before the measured ones", low=0)
    rounds: int = option(5, "measured iterations, the median counts", low=1)
    seconds: float = option(60.0, "no further iteration begins after this time, in either phase", unit="s", above=0)
    timeout: float = option(900.0, "a point that takes longer is ended", unit="s", above=0)
    spare_gb: float = option(
        1.0, "a point is ended when less memory than this is left to the machine", unit="GiB", low=0
    )
    force: str = option("no", "measure again what the CSV has", choices=("yes", "no"))
    out: str = option(str(RESULTS / "scaling.csv"), "CSV file; the picture lies beside it")


@dataclass(frozen=True)
class Point:
    """One point of the sweep; see :class:`experiments.benchmarks.scaling_point.PointOptions`."""

    task: str
    engine: str
    num_envs: int
    num_seeds: int
    devices: int
    length: int
    trpo_iterations: int

    @property
    def name(self) -> str:
        """In words."""
        seeds = f" x {self.num_seeds} seeds" if self.num_seeds > 1 else ""
        devices = f" on {self.devices} devices" if self.devices > 1 else ""
        return f"{self.task} {self.engine} {self.num_envs:,} envs{seeds}{devices}"

    @property
    def work(self) -> int:
        """Environments of all seeds."""
        return self.num_envs * self.num_seeds


def numbers(field: str, text: str) -> list[int]:
    """The positive integers of a list with commas.

    Raises:
        ConfigError: something else is in it.
    """
    parts = text.split(",")
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise ConfigError(f"{field}={text}: must be integers >= 1, separated by commas")
    return list(dict.fromkeys(map(int, parts)))


def axes(chosen: ScalingOptions, platform: str) -> tuple[list[str], list[int], list[int], list[int]]:
    """Engines, environments, seeds and devices of the sweep.

    Raises:
        ConfigError: an axis has a value that it must not have.
    """
    on_cpu = platform == "cpu"
    automatic = ["native", "mjx"] if on_cpu else ["mjx"]
    engines = automatic if chosen.engines == "auto" else list(dict.fromkeys(chosen.engines.split(",")))
    for engine in engines:
        if engine not in ENGINES:
            raise ConfigError(f"engines={chosen.engines}: must be auto or some of {', '.join(ENGINES)}")
        if engine == "native" and not on_cpu:
            raise ConfigError(f"engines={chosen.engines}: native runs on a CPU only; this is {platform}")
    envs = (CPU_ENVS if on_cpu else ACCELERATOR_ENVS) if chosen.num_envs == "auto" else chosen.num_envs
    seeds, devices = numbers("num_seeds", chosen.num_seeds), numbers("devices", chosen.devices)
    return engines, numbers("num_envs", envs), seeds, devices


def points(chosen: ScalingOptions, platform: str, horizons: Mapping[str, int]) -> list[Point]:
    """The sweep, small points first.

    Args:
        chosen: its axes.
        platform: ``cpu``, ``gpu``, ...
        horizons: T of each task.

    Raises:
        ConfigError: an axis has a value that it must not have.
    """
    inner = chosen.trpo_iterations or Config().trpo.iterations
    sweep = [
        Point(task, *values, length=chosen.length or -(-LEAST_EPISODES * horizon // inner), trpo_iterations=inner)
        for task, horizon in horizons.items()
        for values in itertools.product(*axes(chosen, platform))
        if values[0] == "mjx" or values[-1] == 1  # the others have one device
    ]
    if not sweep:
        raise ConfigError(f"devices={chosen.devices}: must have 1 in it for engines={chosen.engines}")
    return sorted(sweep, key=lambda point: point.work)


def same(point: Point, row: Mapping[str, str], here: Mapping[str, str]) -> bool:
    """Whether a row of the CSV is this point, of this commit, on this machine."""
    wanted = {key: str(value) for key, value in asdict(point).items()} | dict(here)
    return all(row.get(key, "") == value for key, value in wanted.items())


def too_large(point: Point, rows: Sequence[Mapping[str, str]], here: Mapping[str, str]) -> str:
    """What became of a point of the same kind with no more environments or seeds that was too large; empty: none."""

    def smaller(row: Mapping[str, str]) -> bool:
        envs, seeds = int(row["num_envs"]), int(row["num_seeds"])
        like = replace(point, num_envs=envs, num_seeds=seeds)
        return like != point and envs <= point.num_envs and seeds <= point.num_seeds and same(like, row, here)

    return next((TOO_MUCH[row["status"]] for row in rows if row["status"] in TOO_MUCH and smaller(row)), "")


def expected_s(point: Point, rows: Sequence[Mapping[str, str]]) -> float | None:
    """Seconds that a point takes, after the most similar one measured; None without any.

    What does not grow with the environments is start and compilation; the rest does.
    """
    known = [row for row in rows if row["status"] == "ok"]
    if not known:
        return None

    def unlike(row: Mapping[str, str]) -> tuple[bool, bool, int]:
        return row["task"] != point.task, row["engine"] != point.engine, abs(int(row["num_envs"]) - point.num_envs)

    row = min(known, key=unlike)
    fixed = float(row["start_s"]) + float(row["compile_s"])
    return fixed + (float(row["wall_s"]) - fixed) * point.work / (int(row["num_envs"]) * int(row["num_seeds"]))


def left(todo: Sequence[Point], rows: Sequence[Mapping[str, str]]) -> str:
    """Time that ``todo`` takes, in words."""
    known = [expected_s(point, rows) for point in todo]
    return "?" if None in known else duration(sum(part for part in known if part is not None))


def measure(point: Point, chosen: ScalingOptions, show: Callable[[str], None]) -> dict[str, Any]:
    """The row of one point, run in a process of its own."""
    load = os.getloadavg()[0]
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder) / "point.json", Path(folder) / "log"
        phases = {"warmup": chosen.warmup, "rounds": chosen.rounds, "seconds": chosen.seconds}
        status, note = point_process.run(
            point_process.module("scaling_point", {"out": out, **asdict(point), **phases}),
            log,
            env=point_process.environment(),
            timeout=chosen.timeout,
            spare_gb=chosen.spare_gb,
            show=show,
        )
        known = json.loads(out.read_text()) if out.exists() else {}
    wall = {"wall_s": round(time.monotonic() - begin, 1), "load": round(load, 1)}
    sizes = {**asdict(point), "batch_size": point.length * point.num_envs}
    return {**sizes, **known, **wall, "status": status, "note": note}


def sweep(chosen: ScalingOptions, plan: Sequence[Point], about: Mapping[str, Any]) -> int:
    """Measures what is missing of ``plan`` and writes each row as soon as it is known.

    Args:
        chosen: settings.
        plan: all points.
        about: what :func:`experiments.benchmarks.probe.look` found.

    Returns:
        How many points failed for another reason than memory or time.
    """
    out, here = Path(chosen.out), {key: str(about[key]) for key in ("device", "cpus", "commit")}
    rows = read(out) if out.exists() else []
    command = " ".join(["python -m experiments.benchmarks.scaling", *map(shlex.quote, sys.argv[1:])])

    def done(point: Point) -> bool:
        return any(same(point, row, here) and row["status"] not in ("failed", "refused") for row in rows)

    todo = [point for point in plan if chosen.force == "yes" or not done(point)]
    if len(todo) < len(plan):
        print(f"{len(plan) - len(todo)} of {len(plan)} points are in {out} already (force=yes measures them again)")
    failures = 0
    with Display() as display:
        for k, point in enumerate(todo):
            mine = [row for row in rows if all(row[key] == value for key, value in here.items())]
            if why := too_large(point, mine, here):
                display.say(f"[{k + 1}/{len(todo)}] {point.name}: left out, a smaller one {why}")
                continue
            begin, before = time.monotonic(), left(todo[k:], mine)
            head = f"point {k + 1}/{len(todo)}: {point.name}"

            def show(line: str, head: str = head, begin: float = begin, before: str = before) -> None:
                display.show(f"{head}, {duration(time.monotonic() - begin)} of {before} left at its start", line)

            show("starting")
            found = {**about, **measure(point, chosen, show), "command": command}
            row = {column: str(found.get(column, "")) for column in COLUMNS}
            rows = [*(old for old in rows if not same(point, old, here)), row]
            write_rows(out, rows)
            failures += row["status"] in ("failed", "refused")
            display.say(f"[{k + 1}/{len(todo)}] {describe(row, point)}  ETA {left(todo[k + 1 :], [*mine, row])}")
    return failures


def describe(row: Mapping[str, str], point: Point) -> str:
    """A finished point in one line."""
    if row["status"] != "ok":
        return f"{point.name}: {row['status']} ({row['note']})"
    memory = f"{row['device_gb']} GiB of the device" if row["device_gb"] else f"peak {row['peak_gb']} GiB"
    return f"{point.name}: {int(row['steps_per_s']):,} env-steps/s, compiled in {row['compile_s']} s, {memory}"


def main() -> int:
    """Sweeps and draws; returns the exit code: 1 if a point failed, 2 for wrong settings."""
    chosen = options(ScalingOptions, "experiments.benchmarks.scaling")
    try:
        tasks = list(dict.fromkeys(chosen.tasks.split(",")))
        for task in tasks:
            resolve_name("task", task)
        axes(chosen, "cpu")  # what is wrong on every machine is said at once
        about = probe.look(tasks)
        plan = points(chosen, about["platform"], about["horizons"])
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a point must not outlive its sweep
    try:
        failures = sweep(chosen, plan, about)
    except KeyboardInterrupt:
        print("stopped; the same command goes on where it was", file=sys.stderr)
        return 130
    from experiments.benchmarks.scaling_plot import draw

    try:
        print(f"{chosen.out}, {draw(Path(chosen.out), str(about['device']))}")
    except ValueError as error:
        print(error)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
