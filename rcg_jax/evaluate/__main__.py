"""Success of a trained policy on rho_0 (appendix A.2): ``python -m rcg_jax.evaluate run=DIR``, or ``policy=NAME``."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.config.arguments import output_file, run_command
from rcg_jax.config.class_path import class_name
from rcg_jax.config.names import ENGINES
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.evaluate.perturb import (
    PERTURBATIONS,
    ROBUSTNESS_COLUMNS,
    conditions,
    evaluate_perturbed,
    parse_perturbations,
    robustness_rows,
    robustness_table,
)
from rcg_jax.evaluate.regions import COLUMNS, Cell, region_rows
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.runs.evaluation import append_rows, check_columns, evaluate_run, row, table
from rcg_jax.runs.load import LoadedRun, Trained, load_policy_with_task, load_run


@dataclass(frozen=True)
class EvaluateOptions:
    """Settings of ``python -m rcg_jax.evaluate``."""

    run: str = option("", "folder of a seed: <run_dir>/<task>/<method>/seed<k>")
    policy: str = option("", "instead of run: name of a shipped policy, or a policy's file *.npz")
    task: str = option("", "of policy=...: the task to try it on; default: its own")
    engine: str = option("", "physics; default: the one that it was trained with", choices=ENGINES)
    episodes: int = option(2_000, "episodes of each policy", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    iteration: str = option("newest", "of run=...: checkpoint: newest, or a number of iterations")
    out: str = option("", "file *.csv to which the success by region, or under each perturbation, is added")
    perturb: str = option(
        "", f"also success in a changed world: {', '.join(PERTURBATIONS)}, with commas between, or all"
    )


def _load(options: EvaluateOptions) -> Trained:
    engine = options.engine or ("native" if options.perturb else None)
    iteration = options.iteration
    if options.policy:
        if iteration != "newest":
            raise ConfigError(f"iteration={iteration}: only with run=...; a policy's file holds one iteration")
        return load_policy_with_task(options.policy, engine=engine, task=options.task or None)
    if options.task:
        raise ConfigError(f"task={options.task}: only with policy=...; a run knows its task")
    if iteration != "newest" and not iteration.isdecimal():
        raise ConfigError(f"iteration={iteration}: must be newest or a number >= 1")
    number = None if iteration == "newest" else int(iteration)
    run = load_run(Path(options.run), engine=engine, iteration=number)
    for damage in run.damaged:
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    return run


def _evaluate(options: EvaluateOptions, words: Sequence[str]) -> None:
    out = output_file(options.out, ".csv")
    perturbed = parse_perturbations(options.perturb) if options.perturb else []
    if out:
        check_columns(out, ROBUSTNESS_COLUMNS if perturbed else COLUMNS)  # before the episodes
    enable_compilation_cache()
    run = _load(options)
    name = f"{run.path}, iteration {run.iteration} ({run.env_steps:,} steps), engine {run.task.engine.name}"
    print(f"{name}: {options.episodes} episodes of each policy ...", flush=True)
    begin = time.monotonic()
    result = evaluate_run(run, episodes=options.episodes, seed=options.seed)
    print(f"\n{table(result)}\n")
    tables = {}
    if isinstance(run, LoadedRun):
        command = shlex.join(["python", "-m", "rcg_jax.evaluate", *words])
        cells = row(run, result, command=command, episodes=options.episodes, seed=options.seed)
        tables[run.path / "evaluation.csv"] = [cells]
    if perturbed:
        rows = _perturbed(options, run, perturbed, shlex.join(["python", "-m", "rcg_jax.evaluate", *words]))
        tables |= {
            path: rows for path in (run.path / "robustness.csv" if isinstance(run, LoadedRun) else None, out) if path
        }
    elif out:
        tables[out] = region_rows(
            result.regions,
            task=class_name(options.task) or run.task_name,
            seed=run.seed,
            method=run.method,
            env_steps=run.env_steps,
            engine=run.task.engine.name,
            evaluation_seed=options.seed,
            starts_sha256=result.starts_sha256,
        )
    for path, rows in tables.items():
        append_rows(path, rows)
    where = f"; added to {' and '.join(map(str, tables))}" if tables else ""
    print(f"feasible starts sha256 {result.starts_sha256[:16]}; {time.monotonic() - begin:.0f} s{where}")


def _perturbed(options: EvaluateOptions, run: Trained, names: list[str], command: str) -> list[dict[str, Cell]]:
    """Success under each perturbation: printed, and as rows."""
    held = run.pi.action_repeat * run.task.model.opt.timestep
    print(f"{options.episodes} episodes under each of {len(conditions(names))} conditions ...", flush=True)
    results = evaluate_perturbed(run.task, run.pi, run.actor, names=names, episodes=options.episodes, seed=options.seed)
    print(f"\n{robustness_table(results, held)}\n")
    about: dict[str, Cell] = {
        "command": command,
        "task": class_name(options.task) or run.task_name,
        "method": run.method,
        "training_seed": run.seed,
        "iteration": run.iteration,
        "env_steps": run.env_steps,
        "seed": options.seed,
        "action_s": held,
    }
    return robustness_rows(results, about)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    return run_command(EvaluateOptions, "rcg_jax.evaluate", argv, _evaluate, instead=("policy",))


if __name__ == "__main__":
    sys.exit(main())
