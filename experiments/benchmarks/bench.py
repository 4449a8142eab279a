"""Speed, start-up and memory, as ratios measured in one run.

    make bench                                # python -m experiments.benchmarks.bench
    python -m experiments.benchmarks.bench engines=native rounds=3
    python -m experiments.benchmarks.bench engines=mjx startup=0 num_envs=4096 batch_size=1024000   # on a GPU

Throughput is taken in turns, raw physics and training alternating, so that a machine that slows down slows both;
ratios are medians over the rounds of each round's ratio. Training counts the steps of policy rollouts and pays for
everything: Brownian walks, TRPO, baseline, labels. Compilation and evaluation are left out. For another batch size the
baseline's minibatches are scaled, so that it takes as many Adam steps.

"raw mjx.step" is stock MJX under jit and vmap, "raw engine=mjx" what this package runs; ratios are given to both.
engine=warp is given as a ratio to engine=mjx.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmarks.raw_physics import mjx_runner, native_runner, random_controls, stock_mjx_runner, warp_runner
from experiments.benchmarks.training import Training, measured, sized
from experiments.common import arguments, machine, write_rows
from rcg_jax.config.settings import Config
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.tasks import make_task
from rcg_jax.tasks.training import resolve
from rcg_jax.types import sample_starts

DEFAULTS = {
    "task": "ring_peg",
    "engines": "native,mjx",
    "rounds": 5,
    "warmup": 5,
    "num_envs": 0,
    "batch_size": 0,
    "num_seeds": 1,
    "startup": 1,
    "nthread": 2,
    "memory_iterations": 15,
    "strict": 1,
    "out": "experiments/results/bench.csv",
}


#: Physics steps of one raw measurement, and least number of environments in it: fewer are slower.
RAW_STEPS = 100
LEAST_RAW = 400


def throughput(args: dict[str, Any], engine: str) -> list[dict[str, Any]]:
    """Raw physics of the engines that ``engine`` is compared with, and training on it, in turns."""
    enable_compilation_cache()
    config = resolve(Config(task=args["task"], engine=engine, num_seeds=args["num_seeds"]), ())[0]
    config = sized(config, num_envs=args["num_envs"], batch=args["batch_size"])
    training = Training(config)
    task = make_task(config.task, engine)
    envs = config.rollout.num_envs
    batch = max(envs * args["num_seeds"], LEAST_RAW)
    qpos = np.asarray(sample_starts(jax.random.key(0), task.feasible_starts(), batch).qpos)
    for _ in range(args["warmup"]):  # past the first iterations, when all is close to the goal
        training.run()
    on_cpu = jax.default_backend() == "cpu"
    ctrl = random_controls(task.model, RAW_STEPS, batch)
    makers = {
        "raw native": lambda: native_runner(task.model, qpos, ctrl, nthread=args["nthread"]),
        "raw mjx.step": lambda: stock_mjx_runner(task.model, qpos, ctrl),
        "raw engine=mjx": lambda: mjx_runner(task.model, qpos, ctrl),
        "raw engine=warp": lambda: warp_runner(task.model, qpos, ctrl),
    }
    wanted = {"native": ["raw native"], "warp": ["raw engine=warp", "raw engine=mjx"]}.get(
        engine, ["raw native"] * on_cpu + ["raw mjx.step", "raw engine=mjx"]
    )
    raw = {name: makers[name]() for name in wanted}
    series: dict[str, list[float]] = {name: [] for name in (*raw, "training")}
    for round_ in range(args["rounds"]):
        for name, run in raw.items():
            begin = time.perf_counter()
            run()
            series[name].append(RAW_STEPS * batch / (time.perf_counter() - begin))
        series["training"].append(training.env_steps / training.run())
        shown = ", ".join(f"{name} {values[-1]:,.0f}" for name, values in series.items())
        print(f"{engine}: round {round_ + 1}/{args['rounds']}: env steps/s {shown}", flush=True)

    def ratio(a: str, b: str) -> float:
        return float(np.median([x / y for x, y in zip(series[a], series[b])]))

    common = {"engine": engine, "num_envs": envs, "num_seeds": args["num_seeds"]}
    rows = [
        {"name": f"{name} steps/s", "value": round(float(np.median(values))), **common}
        for name, values in series.items()
    ]
    rows.append({"name": "train step compile s", "value": round(training.compile_s, 1), **common})
    if engine == "mjx":
        for name in ("mjx.step", "engine=mjx"):
            value = ratio("training", f"raw {name}")
            rows.append({"name": f"training / raw {name}", "value": value, "target": ">= 0.7", **common})
        if on_cpu:
            for name in ("engine=mjx", "mjx.step"):
                value = ratio(f"raw {name}", "raw native")
                rows.append({"name": f"raw {name} / raw native", "value": value, "target": ">= 0.25", **common})
            rows.append({"name": "training on mjx / raw native", "value": ratio("training", "raw native"), **common})
    elif engine == "warp":
        rows.append({"name": "training / raw engine=warp", "value": ratio("training", "raw engine=warp"), **common})
        value = ratio("raw engine=warp", "raw engine=mjx")
        rows.append({"name": "raw engine=warp / raw engine=mjx", "value": value, **common})
    else:
        value = ratio("training", "raw native")
        rows.append({"name": "training / raw native", "value": value, "target": ">= 0.5", **common})
    return rows


def command(args: dict[str, Any], engine: str, folder: Path, iterations: int) -> list[str]:
    """A run as a user starts it."""
    return [
        *(sys.executable, "-m", "rcg_jax.run"),
        *(f"task={args['task']}", f"engine={engine}", f"run_dir={folder}", f"iterations={iterations}", "eval_every=0"),
        "write_report=false",
    ]


def first_iteration(args: dict[str, Any], engine: str, cache: Path) -> float:
    """Seconds from starting the command until the first iteration's row is in metrics.csv."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = Path(folder) / args["task"] / "reverse" / "seed0" / "metrics.csv"
        begin = time.perf_counter()
        process = subprocess.Popen(
            command(args, engine, Path(folder), 1000),
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)},
            stdout=subprocess.DEVNULL,
        )
        while process.poll() is None and not (metrics.exists() and metrics.read_text().count("\n") >= 2):
            time.sleep(0.05)
        seconds = time.perf_counter() - begin
        if process.poll() is not None:
            raise RuntimeError(f"the run ended with exit code {process.returncode}")
        process.kill()
        process.wait()
        return seconds


def startup(args: dict[str, Any], engine: str) -> list[dict[str, Any]]:
    """First iteration with an empty compilation cache and with a filled one."""
    cache = Path(tempfile.mkdtemp())
    try:
        cold, warm = first_iteration(args, engine, cache), first_iteration(args, engine, cache)
    finally:
        shutil.rmtree(cache)
    limits = {"native": ("<= 20", "<= 20"), "mjx": ("<= 75", "<= 25")}.get(engine)
    rows = [
        {"name": "first iteration s, cold cache", "engine": engine, "value": round(cold, 1)},
        {"name": "first iteration s, warm cache", "engine": engine, "value": round(warm, 1)},
    ]
    return [{**row, "target": limit} for row, limit in zip(rows, limits, strict=True)] if limits else rows


def memory(args: dict[str, Any], engine: str) -> list[dict[str, Any]]:
    """Peak memory of a run's process, and how much of it came after the fifth iteration.

    Raises:
        RuntimeError: the run failed.
    """
    early = late = 0.0
    with tempfile.TemporaryDirectory() as folder:
        iterations = args["memory_iterations"]
        process = subprocess.Popen(command(args, engine, Path(folder), iterations), stdout=subprocess.DEVNULL)
        metrics = Path(folder) / args["task"] / "reverse" / "seed0" / "metrics.csv"
        while process.poll() is None:
            rows = metrics.read_text().count("\n") - 1 if metrics.exists() else 0
            late = max(late, _peak_gb(process.pid))
            if rows >= 5 and not early:
                early = late
            if rows >= iterations:  # what follows is the evaluation, another program
                break
            time.sleep(0.1)
        during = late
        while process.poll() is None:
            late = max(late, _peak_gb(process.pid))
            time.sleep(0.1)
    if process.returncode:
        raise RuntimeError(f"the run ended with exit code {process.returncode}")
    growth = {"name": "peak memory growth GB, iterations 5 to last", "value": during - early, "target": "<= 0.1"}
    return [
        {"name": "peak memory GB, evaluation included", "engine": engine, "value": late, "target": "<= 2"},
        {**growth, "engine": engine},
    ]


def _peak_gb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 0.0


def meets(value: float, target: str) -> bool:
    """Whether ``value`` meets a target like ``>= 0.5``."""
    relation, bound = target.split()
    return value >= float(bound) if relation == ">=" else value <= float(bound)


def main() -> None:
    """Measures everything and writes the CSV; exits with 1 if a target was missed, unless strict=0."""
    args = arguments(DEFAULTS)
    engines = args["engines"].split(",")
    rows: list[dict[str, Any]] = []
    if args["startup"]:
        for engine in engines:
            rows += startup(args, engine)
            rows += memory(args, engine)
    for engine in engines:
        rows += measured(engine, throughput, args, engine)
    about = machine()
    for row in rows:
        row["value"] = round(row["value"], 3)
        row["met"] = meets(row["value"], row["target"]) if "target" in row else ""
        print(f"{row['name']:46s} {row['engine']:7s} {row['value']:>12,}  {row.get('target', ''):8s} {row['met']}")
    columns = ("name", "engine", "value", "target", "met", "num_envs", "num_seeds")
    write_rows(Path(args["out"]), [{column: row.get(column, "") for column in columns} | about for row in rows])
    sys.exit(bool(args["strict"]) and any(row["met"] is False for row in rows))


if __name__ == "__main__":
    main()
