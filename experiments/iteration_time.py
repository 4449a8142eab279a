"""Whether iterations take the same time, and the process the same memory, from the first to the last of a long run.

    python -m experiments.iteration_time                    # 1,000 small iterations; --help lists the settings

Runs ``python -m rcg_jax.run`` as a user does, with walks of constant length, so that every iteration has the same work.
From ``metrics.csv`` it takes the wall clock at the end of each iteration. The slope is a straight line's through the
medians of blocks of iterations, the first block left out, with a 95 % confidence interval; the medians keep out what
else the machine does now and then, and checkpoints. The same for the processor time of the blocks, all threads
together, which other programs on the machine disturb less. Writes results/iteration_time.csv, a row for each block.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.live import Display, last_line
from experiments.report import RESULTS, machine, options, read, write_rows
from rcg_jax.config.settings import ConfigError, option

#: Small, and the same work in every iteration.
TINY = (
    "rollout.num_envs=20 rollout.batch_size=2000 baseline.minibatch_size=500 curriculum.num_candidates=500 "
    "curriculum.brownian_horizon_max=50"
)


@dataclass(frozen=True)
class IterationOptions:
    """Settings of ``python -m experiments.iteration_time``."""

    iterations: int = option(1_000, "iterations of the run", low=100)
    block: int = option(20, "iterations whose median is one point", low=1)
    task: str = option("point_maze", "task")
    engine: str = option("native", "physics engine")
    settings: str = option(TINY, "further settings of the run, separated by spaces")
    out: str = option(str(RESULTS / "iteration_time.csv"), "CSV file")


@dataclass(frozen=True)
class Slope:
    """A line through the blocks' medians.

    Attributes:
        median_s: median over the blocks [s].
        change: growth over the whole run, relative to that.
        low, high: 95 % confidence interval of ``change``.
    """

    median_s: float
    change: float
    low: float
    high: float


def block_medians(seconds: np.ndarray, block: int) -> np.ndarray:
    """Medians of consecutive blocks of ``block`` iterations; what does not fill one is left out."""
    whole = len(seconds) // block * block
    return np.median(np.asarray(seconds[:whole]).reshape(-1, block), axis=1)


def slope(medians: np.ndarray) -> Slope:
    """Least squares through the blocks' medians, at least four, with normal errors of the estimated width."""
    x = np.linspace(0.0, 1.0, len(medians))
    design = np.stack([np.ones_like(x), x], axis=1)
    found, *_ = np.linalg.lstsq(design, medians, rcond=None)
    residual = medians - design @ found
    variance = residual @ residual / (len(medians) - 2)
    error = float(np.sqrt(variance * np.linalg.inv(design.T @ design)[1, 1]))
    middle = float(np.median(medians))
    # Quantile of Student's t for 97.5 %, by its expansion about the normal one: within 1 % from 8 blocks on.
    z, free = 1.959964, len(medians) - 2
    quantile = z + (z**3 + z) / (4 * free) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * free**2)
    change = float(found[1])
    return Slope(middle, change / middle, (change - quantile * error) / middle, (change + quantile * error) / middle)


@dataclass(frozen=True)
class Sample:
    """The process at one moment: iterations done, its memory [GiB], and its processor time so far [s]."""

    done: int
    memory_gb: float
    cpu_s: float


def sample(pid: int, done: int) -> Sample | None:
    """A process now; None where the system does not say."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        memory = next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmRSS"))
        user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    except (OSError, StopIteration):
        return None
    return Sample(done, memory, (int(user) + int(system)) / os.sysconf("SC_CLK_TCK"))


def block_cpu(samples: Sequence[Sample], blocks: int, block: int) -> np.ndarray:
    """Processor time of an iteration in each block [s], (blocks,), between the samples by straight lines."""
    done = [each.done for each in samples]
    edges = np.interp(np.arange(blocks + 1) * block, done, [each.cpu_s for each in samples])
    return np.diff(edges) / block


def run(chosen: IterationOptions, folder: Path) -> tuple[np.ndarray, list[Sample]]:
    """Runs and returns the wall clock after each iteration [s], and the process about every second.

    Raises:
        RuntimeError: the run failed; its last line.
    """
    command = [
        *(sys.executable, "-m", "rcg_jax.run", f"task={chosen.task}", f"engine={chosen.engine}", f"run_dir={folder}"),
        *(f"iterations={chosen.iterations}", "eval_every=0", "evaluation.final_episodes=10", *chosen.settings.split()),
    ]
    samples: list[Sample] = []
    log = folder / "log"
    with Display() as display, log.open("wb") as out:
        display.say(" ".join(["python", *command[1:]]))
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        try:
            while process.poll() is None:
                time.sleep(1.0)
                files = list(folder.rglob("metrics.csv"))
                done = files[0].read_text().count("\n") - 1 if files else 0
                now = sample(process.pid, done)
                if now is not None and 0 < done < chosen.iterations:
                    samples.append(now)
                display.show(last_line(log) or "starting")
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    if process.returncode:
        raise RuntimeError(last_line(log))
    (file,) = folder.rglob("metrics.csv")
    return np.array([float(row["wall_s"]) for row in read(file)]), samples


def say(wall: Slope, cpu: Slope, iterations: int, samples: Sequence[Sample]) -> str:
    """The result in words."""
    lines = [
        f"{what} of an iteration: {1e3 * found.median_s:.1f} ms; from the first to the last of {iterations} it changes "
        f"by {100 * found.change:+.1f} % [{100 * found.low:+.1f}, {100 * found.high:+.1f}]"
        for what, found in (("wall clock", wall), ("processor time", cpu))
    ]
    settled = [each.memory_gb for each in samples if each.done > iterations / 10]
    if settled:
        lines.append(f"memory after the first tenth: from {settled[0]:.3f} to {settled[-1]:.3f} GiB")
    return "\n".join(lines)


def main() -> int:
    """Measures, prints and writes; returns the exit code: 1 if the run failed, 2 for wrong settings."""
    chosen = options(IterationOptions, "experiments.iteration_time")
    try:
        if chosen.iterations < 10 * chosen.block:
            raise ConfigError(f"block={chosen.block}: must be <= {chosen.iterations // 10}, a tenth of iterations")
        with tempfile.TemporaryDirectory() as folder:
            wall, samples = run(chosen, Path(folder))
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"error: the run failed: {error}", file=sys.stderr)
        return 1
    medians = block_medians(np.diff(wall), chosen.block)
    cpu = block_cpu(samples, len(medians), chosen.block) if samples else np.zeros(len(medians))
    found, found_cpu = slope(medians[1:]), slope(cpu[1:])
    print(say(found, found_cpu, chosen.iterations, samples))
    common = {"task": chosen.task, "engine": chosen.engine}
    for name, each in (("wall", found), ("cpu", found_cpu)):
        common |= {f"{name}_change": f"{each.change:.4f}", f"{name}_low": f"{each.low:.4f}"}
        common |= {f"{name}_high": f"{each.high:.4f}"}
    common |= {**machine(), "command": shlex.join(["python", "-m", "experiments.iteration_time", *sys.argv[1:]])}
    rows = []
    for k, (seconds, busy) in enumerate(zip(medians, cpu, strict=True)):
        last = (k + 1) * chosen.block
        known = [each.memory_gb for each in samples if each.done <= last]
        measured = {"last_iteration": last, "wall_s": f"{seconds:.5f}", "cpu_s": f"{busy:.5f}"}
        rows.append({**measured, "memory_gb": round(known[-1], 4) if known else "", **common})
    write_rows(Path(chosen.out), rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
