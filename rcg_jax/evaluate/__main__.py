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

#: Rows for each file.
Tables = dict[Path, list[dict[str, Cell]]]


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
    out, names = output_file(options.out, ".csv"), parse_perturbations(options.perturb) if options.perturb else []
    if out:
        check_columns(out, ROBUSTNESS_COLUMNS if names else COLUMNS)  # before the episodes
    enable_compilation_cache()
    run, begin = _load(options), time.monotonic()
    about = f"{run.path}, iteration {run.iteration} ({run.env_steps:,} steps), engine {run.task.engine.name}"
    command = shlex.join(["python", "-m", "rcg_jax.evaluate", *words])
    tables = (_perturbed if names else _usual)(options, run, out, about, command)
    for path, rows in tables.items():
        append_rows(path, rows)
    where = f"; added to {' and '.join(map(str, tables))}" if tables else ""
    print(f"feasible starts sha256 {run.task.starts_sha256()[:16]}; {time.monotonic() - begin:.0f} s{where}")


def _usual(options: EvaluateOptions, run: Trained, out: Path | None, about: str, command: str) -> Tables:
    """Success by region: printed, and the rows of each file."""
    print(f"{about}: {options.episodes} episodes of each policy ...", flush=True)
    result = evaluate_run(run, episodes=options.episodes, seed=options.seed)
    print(f"\n{table(result)}\n")
    tables: Tables = {}
    if isinstance(run, LoadedRun):
        cells = row(run, result, command=command, episodes=options.episodes, seed=options.seed)
        tables[run.path / "evaluation.csv"] = [cells]
    if out:
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
    return tables


def _perturbed(options: EvaluateOptions, run: Trained, out: Path | None, about: str, command: str) -> Tables:
    """Success under each perturbation: printed, and the rows of each file."""
    names = parse_perturbations(options.perturb)
    cases = conditions(run.task, names, skip=options.perturb == "all")
    if missing := [name for name in names if name not in {case.name for case in cases}]:
        print(f"left out, for the model has none or cannot scale it: {', '.join(missing)}")
    files = [path for path in (run.path / "robustness.csv" if isinstance(run, LoadedRun) else None, out) if path]
    for path in files:
        check_columns(path, ROBUSTNESS_COLUMNS)
    print(f"{about}: {options.episodes} episodes of each policy under each of {len(cases)} conditions ...", flush=True)
    held = run.pi.action_repeat * run.task.model.opt.timestep
    results = evaluate_perturbed(run.task, run.pi, run.actor, cases=cases, episodes=options.episodes, seed=options.seed)
    print(f"\n{robustness_table(results, held)}\n")
    same: dict[str, Cell] = {
        "command": command,
        "task": class_name(options.task) or run.task_name,
        "method": run.method,
        "training_seed": run.seed,
        "iteration": run.iteration,
        "env_steps": run.env_steps,
        "seed": options.seed,
        "action_s": held,
    }
    return {path: robustness_rows(results, same) for path in files}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    return run_command(EvaluateOptions, "rcg_jax.evaluate", argv, _evaluate, instead=("policy",))


if __name__ == "__main__":
    sys.exit(main())
