"""What each task costs: contacts, speed of raw physics, compilation, and how far the engines agree.

    python -m experiments.task_table                                     # all tasks: minutes each, on a quiet machine
    python -m experiments.task_table tasks=ring_peg what=physics,agreement
    python -m experiments.task_table --help

A task's row in the CSV is written as soon as a part of it is measured, and other rows and parts stay: measure task by
task, or go on where it stopped. ``command`` is that of the row's last measurement.

- ``contacts``: C MuJoCo's contacts per step, mean over random actions from rho_0, and how many there could be.
- ``physics``: env-steps/s of ``mujoco.batch``, engine=mjx and stock ``mjx.step``, in turns (experiments.raw_physics).
- ``compile``: seconds to trace and compile the train step with default settings, without any cache.
- ``agreement``: how far positions differ between the engines after some steps from the same starts of rho_0 under the
  same random actions, [rad, m]: median, 99th percentile and maximum over the environments of the largest difference.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.batch import Batch

from experiments.raw_physics import compare, draw_starts, random_controls
from experiments.report import machine, options, write_rows
from rcg_jax.config.settings import Config, ConfigError, option
from rcg_jax.physics.contact_solver.collide import COLLIDERS
from rcg_jax.physics.engine import reset
from rcg_jax.physics.jit import jit
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.mjx_import import collision_driver
from rcg_jax.runs.task_settings import with_task_settings
from rcg_jax.tasks import TASKS, make_task
from rcg_jax.train_step import init_train_state, make_train_step
from rcg_jax.types import PhysicsState

PARTS = ("contacts", "physics", "compile", "agreement")


@dataclass(frozen=True)
class TableOptions:
    """Settings of ``python -m experiments.task_table``."""

    tasks: str = option(",".join(TASKS), "tasks, separated by commas")
    what: str = option(",".join(PARTS), "parts, separated by commas")
    batch: int = option(256, "environments of raw physics, contacts and agreement", low=1)
    steps: int = option(50, "physics steps per repetition of raw physics", low=1)
    repeats: int = option(5, "repetitions of raw physics; the median counts", low=1)
    stock: str = option(
        "true", "measure stock mjx.step, too, which may take minutes to compile", choices=("true", "false")
    )
    contact_steps: int = option(500, "random steps over which contacts are counted", low=1)
    agree_steps: int = option(20, "steps after which the engines are compared", low=1)
    out: str = option("experiments/results/tasks.csv", "file to write")


def contacts(name: str, chosen: TableOptions) -> dict[str, Any]:
    """Candidate pairs and points of the model, and C MuJoCo's contacts per step under random actions."""
    task = make_task(name, "native")
    model = task.model
    batch = Batch(model, chosen.batch)
    count = batch.bind("ncon")
    batch.qpos[:] = draw_starts(task, chosen.batch)
    total = touching = 0.0
    for ctrl in random_controls(model, chosen.contact_steps, chosen.batch):
        batch.ctrl[:] = ctrl
        batch.step()
        found = np.asarray(count)
        total, touching = total + float(found.mean()), touching + float((found > 0).mean())
    own = MjxEngine(model).solves_contacts
    return {
        "nq": model.nq,
        "nu": model.nu,
        "geom_pairs": len(list(collision_driver.geom_pairs(model))),
        "candidate_contacts": _candidates(model, own),
        "mjx_solver": "own" if own else "mjx.step",
        "contacts_per_step": total / chosen.contact_steps,
        "share_touching": touching / chosen.contact_steps,
    }


def _candidates(model: mujoco.MjModel, own: bool) -> int:
    """Contact points that engine=mjx computes in every step, whether or not anything touches."""
    if own:
        kinds = np.sort(model.geom_type[np.stack([model.pair_geom1, model.pair_geom2], axis=1)], axis=1)
        return sum(COLLIDERS[int(a), int(b)][1] for a, b in kinds)
    return len(collision_driver.make_condim(model))


def physics(name: str, chosen: TableOptions) -> dict[str, Any]:
    """Raw throughput of both engines and of stock MJX."""
    task = make_task(name, "native")
    qpos = draw_starts(task, chosen.batch)
    stock = chosen.stock == "true"
    speed = compare(task.model, qpos, steps=chosen.steps, repeats=chosen.repeats, stock=stock)
    return {
        **{f"{engine}_steps_per_s": round(value) for engine, value in speed.items()},
        "mjx_of_native": speed["mjx"] / speed["native"],
        **({"mjx_of_stock": speed["mjx"] / speed["mjx_stock"]} if stock else {}),
    }


def compile_train_step(name: str, chosen: TableOptions) -> dict[str, Any]:
    """Seconds to trace and compile the train step, per engine."""
    del chosen
    seconds = {}
    for engine in ("native", "mjx"):
        task, config = make_task(name, engine), with_task_settings(Config(task=name, engine=engine), ())
        state = init_train_state(config, task, 0)
        begin = time.perf_counter()
        jit(make_train_step(config, task), donate_argnums=0).lower(state).compile()
        seconds[f"compile_{engine}_s"] = round(time.perf_counter() - begin, 1)
    return seconds


def agreement(name: str, chosen: TableOptions) -> dict[str, Any]:
    """Differences of the engines' positions after a short random trajectory; no row of either may be non-finite."""
    tasks = [make_task(name, engine) for engine in ("native", "mjx")]
    qpos = jnp.asarray(draw_starts(tasks[0], chosen.batch), jnp.float32)
    start = reset(qpos, jnp.zeros((chosen.batch, tasks[0].model.nv)))
    shape = (chosen.agree_steps, chosen.batch, tasks[0].action_dim)
    actions = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, shape), jnp.float32)

    def end(step: Callable[[PhysicsState, Array], PhysicsState]) -> PhysicsState:
        def one(state: PhysicsState, action: Array) -> tuple[PhysicsState, Array]:
            after = step(state, action)
            return after, after.bad

        last, bad = jit(lambda s, a: jax.lax.scan(one, s, a))(start, actions)
        return last.replace(bad=jnp.any(bad, axis=0))

    native, mjx = (end(task.step) for task in tasks)
    difference = np.abs(np.asarray(native.qpos - mjx.qpos)).max(axis=1)
    return {
        "agree_steps": chosen.agree_steps,
        "dq_median": float(np.median(difference)),
        "dq_99": float(np.percentile(difference, 99)),
        "dq_max": float(difference.max()),
        "nonfinite": int(jnp.sum(native.bad | mjx.bad)),
    }


#: How each part is measured.
MEASURE: dict[str, Callable[[str, TableOptions], dict[str, Any]]] = {
    "contacts": contacts,
    "physics": physics,
    "compile": compile_train_step,
    "agreement": agreement,
}


def merge(path: Path, task: str, cells: dict[str, Any]) -> None:
    """Writes ``cells`` into the row of ``task``, which is made if there is none; everything else stays."""
    rows: dict[str, dict[str, Any]] = {}
    if path.exists():
        with path.open(newline="") as file:
            rows = {row["task"]: dict(row) for row in csv.DictReader(file)}
    row = rows.setdefault(task, {"task": task})
    about = machine()
    for name in about:  # last, and in the same columns in every row
        row.pop(name, None)
    row.update({name: f"{x:.4g}" if isinstance(x, float) else x for name, x in cells.items()})
    row.update(about)
    order = [*TASKS, *(name for name in rows if name not in TASKS)]
    columns = ["task", *dict.fromkeys(c for name in order for c in rows.get(name, {}) if c not in ("task", *about))]
    columns += list(about)
    write_rows(path, [{c: rows[name].get(c, "") for c in columns} for name in order if name in rows])


def main() -> int:
    """Measures, prints and writes; returns the exit code."""
    chosen = options(TableOptions, "experiments.task_table")
    parts = chosen.what.split(",")
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        print(f"error: what={unknown[0]}: must be one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    jax.config.update("jax_enable_compilation_cache", False)  # compilation is measured
    for name in chosen.tasks.split(","):
        for part in parts:
            try:
                cells = MEASURE[part](name, chosen)
            except (ConfigError, ValueError, FileNotFoundError) as error:
                print(f"error: {error}", file=sys.stderr)
                return 2
            shown = ", ".join(f"{key} {x:.4g}" if isinstance(x, float) else f"{key} {x}" for key, x in cells.items())
            print(f"{name}: {part}: {shown}", flush=True)
            merge(Path(chosen.out), name, cells)
    return 0


if __name__ == "__main__":
    sys.exit(main())
