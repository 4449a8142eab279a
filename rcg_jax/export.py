"""A run's newest intact checkpoint as ``policy.npz`` with its card: ``python -m rcg_jax.export run=DIR``.

``run=DIR out=FILE.onnx`` writes that policy as an ONNX graph instead, ``policy=NAME out=FILE.onnx`` any trained one.
``task=NAME out=FILE.xml`` writes the model of a task, with which a policy can be used in MuJoCo alone
(docs/policies.md).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rcg_jax.config.arguments import output_file, run_command
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.runs.recorder import Evaluation, read_evaluation

if TYPE_CHECKING:
    from rcg_jax.policies.policy_file import Policy
    from rcg_jax.runs.load import LoadedRun


@dataclass(frozen=True)
class ExportOptions:
    """Settings of ``python -m rcg_jax.export``."""

    run: str = option("", "folder of a seed: <run_dir>/<task>/<method>/seed<k>")
    policy: str = option("", "instead of run: a shipped policy's name or a file *.npz, to write as FILE.onnx")
    task: str = option("", "instead of run: task whose model to write; a custom one: path/to/file.py:ClassName")
    out: str = option(
        "", "of run: FILE.npz, default policy.npz in its folder, with its card *.json, or FILE.onnx; of task: FILE.xml"
    )
    episodes: int = option(0, "for the card; 0: the largest evaluation in eval.csv, or else 2,000 new episodes", low=0)


def _evaluation(run: LoadedRun, episodes: int) -> Evaluation:
    """The success of a run's policy on rho_0, in so many episodes; see :class:`ExportOptions`."""
    known = None if episodes else read_evaluation(run.path / "eval.csv", run.iteration)
    if known is not None:
        return known
    from rcg_jax.runs.evaluation import evaluate_run

    episodes = episodes or 2_000
    print(f"{run.path}, iteration {run.iteration}: {episodes} episodes of each policy ...", flush=True)
    result = evaluate_run(run, episodes=episodes, seed=0)
    good, good_mean = int(result.stochastic.success.sum()), int(result.mean.success.sum())
    return Evaluation(run.iteration, run.env_steps, good, good_mean, episodes, result.starts_sha256)


def _export_run(options: ExportOptions) -> None:
    folder = Path(options.run)
    out = output_file(options.out, ".npz", ".onnx") or folder / "policy.npz"
    # Imported here: help and refusals come at once.
    from rcg_jax.physics.jit import enable_compilation_cache
    from rcg_jax.policies.policy_file import Policy, card_path, check_card_place, save_policy
    from rcg_jax.runs.load import load_run
    from rcg_jax.runs.policy import make_card

    if out.suffix == ".npz":
        check_card_place(out)
    enable_compilation_cache()
    run = load_run(folder)
    for damage in run.damaged:
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    evaluation = _evaluation(run, options.episodes)
    try:
        card = make_card(run.config, run.task, run.actor, run.iteration, evaluation)
    except ValueError as error:
        raise ConfigError(f"task={run.config.task}: {error}") from None
    if out.suffix == ".onnx":
        _write_onnx(Policy(actor=run.actor, card=card), out)
    else:
        save_policy(out, run.actor, card)
    score, files = card.stochastic, f"{out}, {card_path(out)}" if out.suffix == ".npz" else str(out)
    print(
        f"{files}: iteration {run.iteration}, success on rho_0 {score.rate:.3f} "
        f"[{score.low:.3f}, {score.high:.3f}] (mean action {card.mean.rate:.3f}), {score.episodes} episodes"
    )


def _write_onnx(policy: Policy, out: Path) -> None:
    try:
        from rcg_jax.policies.onnx_file import save_onnx
    except ModuleNotFoundError as error:
        raise ConfigError(f'out={out}: needs {error.name}; pip install "rcg_jax[onnx]"') from None
    save_onnx(policy, out)


def _export_policy(options: ExportOptions) -> None:
    out = output_file(options.out, ".onnx")
    if out is None:
        raise ConfigError("out=FILE.onnx is missing")
    if options.episodes:
        raise ConfigError(f"episodes={options.episodes}: only with run=...; a policy's file has its card")
    from rcg_jax.policies.policy_file import load_policy

    policy = load_policy(options.policy)
    _write_onnx(policy, out)
    print(f"{out}: the mean action of {options.policy}, held for {policy.card.action_repeat} physics steps each")


def _export_model(options: ExportOptions) -> None:
    out = output_file(options.out, ".xml")
    if out is None:
        raise ConfigError("out=FILE.xml is missing")
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


def _export(options: ExportOptions, _: Sequence[str]) -> None:
    if options.run:
        _export_run(options)
    elif options.policy:
        _export_policy(options)
    else:
        _export_model(options)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    return run_command(ExportOptions, "rcg_jax.export", argv, _export, instead=("policy", "task"))


if __name__ == "__main__":
    sys.exit(main())
