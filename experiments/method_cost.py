"""What each start-state method costs: time of a curriculum iteration relative to ``uniform``.

    python -m experiments.method_cost [task=point_maze engine=native]

Every method trains in the same process, one iteration each in turns, so that the ratios mean something on a machine
whose load changes; writes results/method_cost_<task>.csv. The oracle's time holds its labelling episodes, whose steps
are in ``proposal_steps``, and self-play's those of Alice and of Bob's answers.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.report import arguments, machine, write_rows
from rcg_jax.config.class_path import class_name
from rcg_jax.config.settings import Config
from rcg_jax.methods import METHODS
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.runs.task_settings import with_task_settings
from rcg_jax.tasks import make_task
from rcg_jax.train_step import init_train_state, make_train_step

RESULTS = Path(__file__).parent / "results"
DEFAULTS = {"task": "point_maze", "engine": "native", "methods": ",".join(METHODS), "warmup": 4, "rounds": 10}


def main() -> None:
    """Measures, prints and writes the results."""
    args = arguments(DEFAULTS)
    enable_compilation_cache()
    task = make_task(args["task"], args["engine"])
    steps: dict[str, Any] = {}
    states: dict[str, Any] = {}
    methods = args["methods"].split(",")
    unknown = [method for method in methods if method not in METHODS]
    if unknown:
        sys.exit(f"methods={args['methods']}: {unknown[0]} is none of {', '.join(METHODS)}")
    for method in dict.fromkeys(["uniform", *methods]):
        config = with_task_settings(Config(task=args["task"], engine=args["engine"], method=method), ())
        step = jit(make_train_step(config, task), fusion_emitters=task.engine.fusion_emitters, donate_argnums=0)
        states[method] = init_train_state(config, task, 0)
        steps[method] = step.lower(states[method]).compile()
        for _ in range(args["warmup"]):
            states[method], _ = jax.block_until_ready(steps[method](states[method]))
    seconds: dict[str, list[float]] = {method: [] for method in steps}
    proposal: dict[str, list[float]] = {method: [] for method in steps}
    for round_ in range(args["rounds"]):
        for method, step in steps.items():
            begin = time.perf_counter()
            states[method], metrics = jax.block_until_ready(step(states[method]))
            seconds[method].append(time.perf_counter() - begin)
            proposal[method].append(float(metrics.starts.proposal_steps))
        shown = ", ".join(f"{method} {values[-1]:.2f} s" for method, values in seconds.items())
        print(f"round {round_ + 1}/{args['rounds']}: {shown}", flush=True)
    base = np.array(seconds["uniform"])
    about = machine()
    rows = [
        {
            "task": args["task"],
            "engine": args["engine"],
            "method": method,
            "seconds_per_iteration": round(float(np.median(values)), 3),
            "relative_to_uniform": round(float(np.median(np.array(values) / base)), 3),
            "proposal_steps": int(np.mean(proposal[method])),
            **about,
        }
        for method, values in seconds.items()
    ]
    write_rows(RESULTS / f"method_cost_{class_name(args['task'])}.csv", rows)
    for row in rows:
        print(f"{row['method']:11s} {row['seconds_per_iteration']:.2f} s, {row['relative_to_uniform']:.2f} x uniform")


if __name__ == "__main__":
    main()
