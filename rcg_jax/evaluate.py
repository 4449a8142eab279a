"""Success of a trained policy on rho_0 (appendix A.2).

``python -m rcg_jax.evaluate run=DIR [engine=... episodes=... seed=... iteration=...]`` evaluates a finished or
running training run, ``policy=NAME`` a shipped policy or a policy's file.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.config.arguments import run_command
from rcg_jax.config.class_path import class_name
from rcg_jax.config.names import ENGINES
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.evaluation.regions import COLUMNS, region_rows
from rcg_jax.io.console import lenient_output
from rcg_jax.io.starts_file import StartsFileError
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
    out: str = option("", "file *.csv to which the success by region is added")


def _load(options: EvaluateOptions) -> Trained:
    if options.policy:
        if options.iteration != "newest":
            raise ConfigError(f"iteration={options.iteration}: only with run=...; a policy's file holds one iteration")
        return load_policy_with_task(options.policy, engine=options.engine or None, task=options.task or None)
    if options.task:
        raise ConfigError(f"task={options.task}: only with policy=...; a run knows its task")
    if options.iteration != "newest" and not options.iteration.isdecimal():
        raise ConfigError(f"iteration={options.iteration}: must be newest or a number >= 1")
    iteration = None if options.iteration == "newest" else int(options.iteration)
    run = load_run(Path(options.run), engine=options.engine or None, iteration=iteration)
    for damage in run.damaged:
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    return run


def _evaluate(options: EvaluateOptions, argv: Sequence[str]) -> None:
    out = Path(options.out) if options.out else None
    if out and out.suffix != ".csv":
        raise ConfigError(f"out={out}: must end in .csv")
    if out and not out.parent.is_dir():
        raise ConfigError(f"out={out}: no such folder {out.parent}")
    if out:
        check_columns(out, COLUMNS)  # before the episodes
    enable_compilation_cache()
    run = _load(options)
    name = f"{run.path}, iteration {run.iteration} ({run.env_steps:,} steps), engine {run.task.engine.name}"
    print(f"{name}: {options.episodes} episodes of each policy ...", flush=True)
    begin = time.monotonic()
    try:
        result = evaluate_run(run, episodes=options.episodes, seed=options.seed)
    except (FileNotFoundError, StartsFileError) as error:
        raise ConfigError(str(error)) from None
    print(f"\n{table(result)}\n")
    added = []
    if isinstance(run, LoadedRun):
        path = run.path / "evaluation.csv"
        command = shlex.join(["python", "-m", "rcg_jax.evaluate", *argv])
        append_rows(path, [row(run, result, command=command, episodes=options.episodes, seed=options.seed)])
        added.append(path)
    if out:
        rows = region_rows(
            result.regions,
            task=class_name(options.task) or run.task_name,
            seed=run.seed,
            method=run.method,
            env_steps=run.env_steps,
            engine=run.task.engine.name,
            evaluation_seed=options.seed,
            starts_sha256=result.starts_sha256,
        )
        append_rows(out, rows)
        added.append(out)
    where = f"; added to {' and '.join(map(str, added))}" if added else ""
    print(f"feasible starts sha256 {result.starts_sha256[:16]}; {time.monotonic() - begin:.0f} s{where}")


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    words = sys.argv[1:] if argv is None else argv
    return run_command(EvaluateOptions, "rcg_jax.evaluate", words, lambda options: _evaluate(options, words))


if __name__ == "__main__":
    sys.exit(main())
