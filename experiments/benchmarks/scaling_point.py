"""One point of a scaling sweep, in a process of its own that :mod:`experiments.benchmarks.scaling` starts.

    python -m experiments.benchmarks.scaling_point out=point.json task=ring_peg engine=mjx num_envs=4096

The file is replaced after every phase, so that it says how far a point came that ran out of memory or time. Exit
code 2: the settings do not fit.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.common import options
from rcg_jax.config.settings import Config, ConfigError, option
from rcg_jax.config.validate import validate
from rcg_jax.tasks.training import resolve


@dataclass(frozen=True)
class PointOptions:
    """Settings of one point."""

    out: str = option("point.json", "file to write")
    task: str = option("ring_peg", "task")
    engine: str = option("mjx", "physics engine")
    num_envs: int = option(400, "environments of each seed", low=1)
    num_seeds: int = option(1, "seeds in one vmapped program", low=1)
    devices: int = option(1, "devices that share the environments", low=1)
    length: int = option(200, "steps of an environment in a TRPO iteration", low=1)
    trpo_iterations: int = option(5, "TRPO iterations per curriculum iteration", low=1)
    warmup: int = option(2, "iterations before the measured ones", low=0)
    rounds: int = option(5, "measured iterations", low=1)
    seconds: float = option(60.0, "no further iteration begins after this time, in either phase", unit="s", above=0)


def configuration(chosen: PointOptions) -> Config:
    """The run of a point, without its sizes.

    Raises:
        ConfigError: settings that do not fit each other.
    """
    config = Config(task=chosen.task, engine=chosen.engine, num_seeds=chosen.num_seeds, devices=str(chosen.devices))
    config = resolve(config, ())[0]
    config = dataclasses.replace(config, trpo=dataclasses.replace(config.trpo, iterations=chosen.trpo_iterations))
    validate(config)
    return config


def memory_gb(name: str) -> float:
    """Memory of this process [GiB] by its name in ``/proc/self/status``: ``VmRSS`` now, ``VmHWM`` peak."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(name):
                return int(line.split()[1]) / 2**20
    return 0.0


def _restart_peak() -> None:
    """Lets ``VmHWM`` begin again at what is used now, where the system can."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def measure(chosen: PointOptions, write: Any) -> None:
    """Compiles and times the train step.

    Args:
        chosen: the point.
        write: told what is known so far, as columns.

    Raises:
        ConfigError: settings that do not fit each other or the task.
        RuntimeError: the engine does not run on this device, or memory ran out.
    """
    begin = time.monotonic()
    from experiments.benchmarks.training import Training, sized

    batch = chosen.length * chosen.num_envs
    config = sized(configuration(chosen), num_envs=chosen.num_envs, batch=batch)
    print(f"compiling, {batch:,} steps per TRPO iteration", flush=True)
    training = Training(config)
    import jax

    from experiments.common import machine

    known: dict[str, Any] = machine()
    known |= {
        "start_s": round(time.monotonic() - begin - training.compile_s, 1),
        "compile_s": round(training.compile_s, 1),
        "planned_gb": round(training.planned_gb, 4),
        "peak_gb": round(memory_gb("VmHWM"), 3),
    }
    write(known)
    before, all_before = memory_gb("VmRSS"), memory_gb("VmHWM")
    _restart_peak()
    times, cpu = _times(training, chosen)
    after = memory_gb("VmHWM")
    device = jax.local_devices()[0].memory_stats() or {}
    seconds = statistics.median(times)
    known |= {
        "rounds": len(times),
        "iteration_s": round(seconds, 4),
        "env_steps": training.env_steps,
        "steps_per_s": round(training.env_steps / seconds),
        "cpu_s": round(cpu, 4),
        "run_gb": round(max(after - before, 0.0), 3),
        "peak_gb": round(max(after, all_before), 3),
    }
    if "peak_bytes_in_use" in device:
        known["device_gb"] = round(device["peak_bytes_in_use"] / 2**30, 3)
    write(known)


def _times(training: Any, chosen: PointOptions) -> tuple[list[float], float]:
    """Seconds of the measured iterations, at least one; mean processor time of one, all threads together [s]."""
    times: list[float] = []
    busy = 0.0
    for phase, most in (("warm-up", chosen.warmup), ("round", chosen.rounds)):
        end, times, busy = time.monotonic() + chosen.seconds, [], time.process_time()
        while len(times) < most and (not times or time.monotonic() < end):
            times.append(training.run())
            print(f"{phase} {len(times)}/{most}: {training.env_steps / times[-1]:,.0f} env-steps/s", flush=True)
    return times, (time.process_time() - busy) / len(times)


def main() -> int:
    """Measures one point; returns the exit code."""
    chosen = options(PointOptions, "experiments.benchmarks.scaling_point")
    out = Path(chosen.out)

    def write(known: dict[str, Any]) -> None:
        partial = out.with_name(out.name + ".new")
        partial.write_text(json.dumps(known))
        partial.replace(out)

    try:
        measure(chosen, write)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    except (ValueError, FileNotFoundError) as error:
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
