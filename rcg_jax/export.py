"""Writes a trained policy as files that need no checkpoint: ``python -m rcg_jax.export run=DIR``.

The run's newest intact checkpoint becomes ``policy.npz`` and its card ``policy.json``
(:mod:`rcg_jax.policies.policy_file`). A finished run has them already. ``python -m rcg_jax.export task=NAME
out=FILE.xml`` writes the model of a task as one MJCF file, with which a policy can be used in MuJoCo alone
(docs/policies.md).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rcg_jax.config.arguments import parse_arguments
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.io.console import lenient_output, tell
from rcg_jax.runs.recorder import Evaluation

if TYPE_CHECKING:
    from rcg_jax.runs.load import LoadedRun

#: Name of the policy's file in a run's folder; the card has the suffix ``.json``.
#: (:data:`rcg_jax.runs.policy.FILE`, which imports JAX.)
POLICY_FILE = "policy.npz"

_USAGE = """usage: python -m rcg_jax.export run=DIR [out=FILE.npz] [episodes=N]
       python -m rcg_jax.export task=NAME out=FILE.xml

Writes the policy of a run's newest intact checkpoint as a file and a card (docs/policies.md), or the model of a task.

  run=DIR        folder of a seed: <run_dir>/<task>/<method>/seed<k>
  out=FILE.npz   file to write; default: policy.npz in the run's folder. The card is beside it, *.json
  episodes=N     evaluate the policy for its card with so many episodes. Default: take the evaluation of that iteration
                 with most episodes from eval.csv, and where there is none, evaluate it with 2,000
  task=NAME      task whose model to write; a class of your own: path/to/file.py:ClassName"""


@dataclass(frozen=True)
class ExportOptions:
    """Settings of ``python -m rcg_jax.export``."""

    run: str = option("", "folder of a seed: <run_dir>/<task>/<method>/seed<k>")
    task: str = option("", "instead of run: task whose model to write")
    out: str = option("", "file to write")
    episodes: int = option(0, "episodes of the evaluation for the card; 0: take it from eval.csv", low=0)


def evaluation_of(run: LoadedRun, episodes: int) -> Evaluation:
    """The success of a run's policy on rho_0.

    Args:
        run: the run.
        episodes: evaluate it now with so many; 0: what eval.csv says about its iteration, or 2,000 if nothing.

    Raises:
        ConfigError: the task has no feasible starts.
    """
    from rcg_jax.runs.recorder import read_evaluation

    known = None if episodes else read_evaluation(run.path / "eval.csv", run.iteration)
    if known is not None:
        return known
    from rcg_jax.io.starts_file import StartsFileError
    from rcg_jax.runs.evaluation import evaluate_run

    episodes = episodes or 2_000
    print(f"{run.path}, iteration {run.iteration}: {episodes} episodes of each policy ...", flush=True)
    try:
        result = evaluate_run(run, episodes=episodes, seed=0)
    except (FileNotFoundError, StartsFileError) as error:
        raise ConfigError(str(error)) from None
    good, good_mean = int(result.stochastic.success.sum()), int(result.mean.success.sum())
    return Evaluation(run.iteration, run.env_steps, good, good_mean, episodes, result.starts_sha256)


def _export_run(options: ExportOptions) -> None:
    if not Path(options.run).is_dir():
        raise ConfigError(f"run={options.run}: no such folder; a run's folder is <run_dir>/<task>/<method>/seed<k>")
    out = Path(options.out) if options.out else Path(options.run) / POLICY_FILE
    _check_out(out, ".npz")
    from rcg_jax.physics.jit import enable_compilation_cache
    from rcg_jax.policies.policy_file import card_path, check_card_place, save_policy
    from rcg_jax.runs.load import load_run
    from rcg_jax.runs.policy import make_card

    check_card_place(out)
    enable_compilation_cache()
    run = load_run(Path(options.run))
    for damage in run.damaged:
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    evaluation = evaluation_of(run, options.episodes)
    try:
        card = make_card(run.config, run.task, run.actor, run.iteration, evaluation)
    except ValueError as error:
        raise ConfigError(f"task={run.config.task}: {error}") from None
    save_policy(out, run.actor, card)
    print(
        f"{out}, {card_path(out)}: iteration {run.iteration}, success on rho_0 {card.stochastic.rate:.3f} "
        f"[{card.stochastic.low:.3f}, {card.stochastic.high:.3f}] (mean action {card.mean.rate:.3f}), "
        f"{card.stochastic.episodes} episodes"
    )


def _export_model(options: ExportOptions) -> None:
    if not options.out:
        raise ConfigError("out=FILE.xml is missing")
    out = Path(options.out)
    _check_out(out, ".xml")
    from rcg_jax.io.tables import write_atomically
    from rcg_jax.tasks import Task, make_task

    try:
        task = make_task(options.task, "native")
        cls = type(task)
        if cls.make_model is not Task.make_model and cls.make_spec is Task.make_spec:
            raise ConfigError(f"task={options.task}: it overrides make_model, so it has to override make_spec as well")
        spec = task.make_spec()
        spec.compile()
        text = spec.to_xml()
    except (ValueError, RuntimeError) as error:
        raise ConfigError(" ".join(str(error).split())) from None
    write_atomically(out, text.encode())
    print(f"{out}: the model of {options.task}")


def _check_out(out: Path, suffix: str) -> None:
    if out.suffix != suffix:
        raise ConfigError(f"out={out}: must end in {suffix}")
    if not out.parent.is_dir():
        raise ConfigError(f"out={out}: no such folder {out.parent}")


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 2 if it cannot be done as asked, 1 if the file cannot be written."""
    words = sys.argv[1:] if argv is None else list(argv)
    if "-h" in words or "--help" in words:
        print(_USAGE)
        return 0
    try:
        options = parse_arguments(ExportOptions, words)
        if bool(options.run) == bool(options.task):
            raise ConfigError("run=DIR (for its policy) or task=NAME (for its model): one of them is needed")
        if options.run:
            _export_run(options)
        else:
            _export_model(options)
    except (ConfigError, OSError) as error:
        tell(error)
        return 2 if isinstance(error, ConfigError) else 1
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
