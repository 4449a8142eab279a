"""Where the time of a training iteration goes.

    python -m experiments.time_table                        # ring_peg, native and mjx; --help lists the settings

The parts of the train step are compiled on their own and timed in turns with the whole step, all from the same state
after a few iterations of training; medians over the rounds. ``rest`` is what the whole step takes beyond the sum of its
parts: a negative one means that the parts run together faster than alone. ``host`` is what the outer loop adds to a
step: fetching and writing metrics, its thread, and its share of a checkpoint. Wall clock, and the processor time of all
threads, which other programs on the machine disturb less. Writes results/time_table.csv.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import time_parts
from experiments.report import RESULTS, machine, options, write_rows
from experiments.training import Training, measured, sized
from rcg_jax.config.settings import Config, ConfigError, option
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.rl.sizes import batch_size, num_envs
from rcg_jax.runs import checkpoint
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.interrupt import Interrupts
from rcg_jax.runs.recorder import WALL_CLOCK, Recorder
from rcg_jax.runs.seeds import metric_rows
from rcg_jax.runs.start_record import start_row
from rcg_jax.runs.task_settings import with_task_settings
from rcg_jax.tasks import make_task, task_class
from rcg_jax.train_step import make_train_step

POLICY, HOST, REST, WHOLE = "policy and bookkeeping of the rollouts", "host", "rest", "iteration"


@dataclass(frozen=True)
class TableOptions:
    """Settings of ``python -m experiments.time_table``."""

    task: str = option("ring_peg", "task")
    engines: str = option("auto", "engines, separated by commas; auto: native and mjx on a CPU, mjx elsewhere")
    num_envs: int = option(0, "environments; 0: as in a run", low=0)
    batch_size: int = option(0, "steps of a TRPO iteration; 0: as in a run", low=0)
    warmup: int = option(10, "training iterations before", low=0)
    rounds: int = option(9, "measurements of each part; the median counts", low=1)
    out: str = option(str(RESULTS / "time_table.csv"), "CSV file")


def table(step_s: float, host_s: float, parts_s: Mapping[str, float]) -> dict[str, float]:
    """Seconds of each part of an iteration, which add up to :data:`WHOLE`.

    Args:
        step_s: the compiled train step.
        host_s: what the outer loop adds.
        parts_s: the parts, each as often as a step does it, the rollouts with their physics inside.
    """
    own = dict(parts_s)
    physics = own.pop(time_parts.PHYSICS)
    policy = own.pop(time_parts.ROLLOUT) - physics
    rows = {time_parts.PHYSICS: physics, POLICY: policy, **own}
    return {**rows, REST: step_s - sum(rows.values()), HOST: host_s, WHOLE: step_s + host_s}


@dataclass(frozen=True)
class Seconds:
    """Medians of the wall clock, and of the processor time of all threads [s]."""

    wall: dict[str, float]
    cpu: dict[str, float]


def in_turns(actions: Mapping[str, Callable[[], Any]], rounds: int, show: Callable[[int], None]) -> Seconds:
    """What each action takes; every round does all of them."""
    wall: dict[str, list[float]] = {name: [] for name in actions}
    cpu: dict[str, list[float]] = {name: [] for name in actions}
    for round_ in range(rounds):
        for name, act in actions.items():
            begin, busy = time.perf_counter(), time.process_time()
            act()
            wall[name].append(time.perf_counter() - begin)
            cpu[name].append(time.process_time() - busy)
        show(round_ + 1)
    return Seconds(*({name: float(np.median(values)) for name, values in each.items()} for each in (wall, cpu)))


def host_actions(config: Config, state: Any, metrics: Any, recorder: Recorder) -> dict[str, Callable[[], Any]]:
    """What the outer loop does after a step: record its metrics and starts; save a checkpoint."""
    interrupts = Interrupts(lambda line: None)
    done = itertools.count(1)

    def record() -> None:
        # Through the run's interruptible thread, as the step itself.
        fetched = interrupts.call(lambda: jax.device_get(metrics), finish=True)
        number = next(done)
        recorder.add_metrics({**metric_rows(fetched, 1)[0], "iteration": number, **dict.fromkeys(WALL_CLOCK, 0.0)})
        recorder.add_starts(start_row(number, *jax.device_get((state.starts, state.labels))))

    def save() -> None:
        checkpoint.save([recorder.folder.checkpoints], next(done), [state])

    return {"record": record, "checkpoint": save}


def measure(chosen: TableOptions, engine: str, say: Callable[[str], None]) -> tuple[Seconds, Config]:
    """The table of one engine, see :func:`table`; and the configuration measured.

    Raises:
        ConfigError: the sizes do not fit.
    """
    enable_compilation_cache()
    config = sized(
        with_task_settings(Config(task=chosen.task, engine=engine), ()),
        num_envs=chosen.num_envs,
        batch=chosen.batch_size,
    )
    say(f"{engine}: compiling the train step")
    training = Training(config)
    task = make_task(chosen.task, engine)
    for k in range(chosen.warmup):
        seconds = training.run()
        say(f"{engine}: warm-up {k + 1}/{chosen.warmup}, {training.env_steps / seconds:,.0f} env-steps/s")
    state = training.state
    # Compiled again without donation: every round takes the same step.
    step = jit(make_train_step(config, task), fusion_emitters=task.engine.fusion_emitters).lower(state).compile()
    say(f"{engine}: compiling the parts")
    parts = time_parts.make_parts(config, task, state)
    _, metrics = jax.block_until_ready(step(state))
    columns = list(metric_rows(jax.device_get(metrics), 1)[0])
    with tempfile.TemporaryDirectory() as path:
        folder = RunFolder(dataclasses.replace(config, run_dir=path), seed=0)
        folder.path.mkdir(parents=True)
        host = host_actions(config, state, metrics, Recorder(folder, columns, start=0, warn=say))
        actions = {WHOLE: lambda: jax.block_until_ready(step(state)), **{part.name: part.run for part in parts}, **host}
        for act in host.values():
            act()
        begin = time.monotonic()

        def show(done: int) -> None:
            left = (time.monotonic() - begin) / done * (chosen.rounds - done)
            say(f"{engine}: round {done}/{chosen.rounds}, ETA {left:.0f} s")

        found = in_turns(actions, chosen.rounds, show)

    def complete(seconds: dict[str, float]) -> dict[str, float]:
        host_s = seconds["record"] + seconds["checkpoint"] / config.checkpoint_every
        return table(seconds[WHOLE], host_s, {part.name: part.times * seconds[part.name] for part in parts})

    return Seconds(complete(found.wall), complete(found.cpu)), config


def rows_of(found: Seconds, config: Config) -> list[dict[str, Any]]:
    """Rows of the CSV, without those columns that say on what it was measured; shares are of the processor time on a
    CPU and of the wall clock elsewhere.
    """
    task: Any = task_class(config.task)
    about = {"num_envs": num_envs(config, task), "batch_size": batch_size(config, task)}
    steps = about["batch_size"] * config.trpo.iterations
    counted = found.cpu if jax.default_backend() == "cpu" else found.wall
    return [
        {
            "task": config.task,
            "engine": config.engine,
            **about,
            "part": part,
            "wall_ms": round(1e3 * found.wall[part], 2),
            "cpu_ms": round(1e3 * found.cpu[part], 2),
            "share": round(counted[part] / counted[WHOLE], 4),
            "microseconds_per_env_step": round(1e6 * counted[part] / steps, 3),
        }
        for part in found.wall
    ]


def show(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of several engines side by side, as Markdown."""
    engines = list(dict.fromkeys(row["engine"] for row in rows))
    cells = {(row["part"], row["engine"]): row for row in rows}
    heads = [f"{engine}: wall [ms] | CPU [ms] | share" for engine in engines]
    lines = [f"| part | {' | '.join(heads)} |", "|---|" + "--:|--:|--:|" * len(engines)]
    for part in dict.fromkeys(row["part"] for row in rows):
        found = [cells[part, engine] for engine in engines]
        values = " | ".join(f"{row['wall_ms']:.0f} | {row['cpu_ms']:.0f} | {100 * row['share']:.1f} %" for row in found)
        lines.append(f"| {part} | {values} |")
    return "\n".join(lines)


def main() -> int:
    """Measures, prints and writes the table; returns the exit code."""
    chosen = options(TableOptions, "experiments.time_table")
    on_cpu = jax.default_backend() == "cpu"
    engines = ("native,mjx" if on_cpu else "mjx") if chosen.engines == "auto" else chosen.engines
    rows: list[dict[str, Any]] = []
    about = machine()
    try:
        for engine in dict.fromkeys(engines.split(",")):
            rows += rows_of(*measured(engine, measure, chosen, engine, partial(print, flush=True)))
            write_rows(Path(chosen.out), [row | about for row in rows])
    except (ConfigError, ValueError, RuntimeError, FileNotFoundError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    print(show(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
