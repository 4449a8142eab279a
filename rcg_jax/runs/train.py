"""A run from its beginning, or where it was left, to its end, its interruption, or one line that says what failed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax

from rcg_jax.config.settings import Config
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.io.console import one_line
from rcg_jax.io.manifest import brief
from rcg_jax.io.tables import ColumnsError
from rcg_jax.runs.checkpoint import CheckpointError
from rcg_jax.runs.folder import FolderInUseError, RunFolder
from rcg_jax.runs.interrupt import Interrupted, Interrupts, handling
from rcg_jax.runs.logger import logger_class
from rcg_jax.runs.loop import Loop, RunError
from rcg_jax.runs.program import Program, load_program
from rcg_jax.runs.progress import Reporter
from rcg_jax.runs.recorder import Evaluation
from rcg_jax.sharding.hosts import ALONE, Hosts, is_connection_loss


def run(
    config: Config,
    *,
    report: Reporter,
    command: str,
    load: Callable[[Config], Program] = load_program,
    hosts: Hosts = ALONE,
    asked: Sequence[str] = (),
) -> None:
    """Trains, or continues, all seeds of ``config`` until its number of iterations.

    Args:
        config: validated settings.
        report: where to show progress.
        command: what resumes this run, for messages.
        load: builds the program.
        hosts: this process among those that train together.
        asked: settings, ``name=value``, that are as the task asks.

    Raises:
        ConfigError: the folder holds a run with other settings, or settings do not fit the task.
        RunError: it cannot start or go on.
        Interrupted: asked to stop; saved.
    """
    seeds = range(config.seed, config.seed + config.num_seeds)
    loop: Loop | None = None
    with ExitStack() as resources:
        interrupts = Interrupts(report.say)
        resources.enter_context(handling(interrupts.handle))
        resources.callback(report.end)
        try:
            logger_class(config.logger)  # refused before anything is compiled
            try:
                program = load(config)
            except RuntimeError as error:
                raise RunError(one_line(error)) from error
            left_open = [f"rollout.{name}" for name in ("num_envs", "batch_size") if not getattr(config.rollout, name)]
            config = program.config
            folders = [RunFolder(config, seed) for seed in seeds]
            for folder in folders:
                folder.check([word.partition("=")[0] for word in asked], left_open)
            for folder in folders if hosts.is_first else []:
                resources.callback(folder.close)
                folder.open()
            loop = Loop(config, program, folders, report, interrupts, hosts)
            resources.callback(loop.close)
            where = str(folders[0].path) + (f" .. {folders[-1].path.name}" if len(folders) > 1 else "")
            report.say(
                f"task {config.task}, method {config.method}, engine {config.engine}, {program.device}, "
                f"seeds {', '.join(map(str, seeds))}: {where}"
            )
            if asked:
                report.say(f"set by the task: {', '.join(asked)}")
            if program.advice:
                report.say(program.advice)
            finished = loop.run()
            for each in finished:
                _write_products(program, *each, report)
            for folder, *_ in finished if config.write_report else []:
                _write_report(program, folder.path, report, interrupts)
        except (OSError, FolderInUseError, ColumnsError, CheckpointError) as error:
            raise RunError(one_line(error)) from error
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if hosts.number == 1 or not is_connection_loss(error):
                raise
            reached = f"iteration {loop.saved}" if loop is not None and loop.saved else "the beginning"
            raise RunError(
                f"process {hosts.index} of {hosts.number}: another process has ended, or the connection is lost "
                f"({brief(error)}); the same command in all of them resumes from {reached}"
            ) from error
        except Interrupted as stop:
            report.end()
            saved = f"saved at iteration {loop.saved}" if loop is not None and loop.saved else "nothing to save yet"
            report.say(f"{stop}, {saved}; resume with: {command}")
            raise


@contextmanager
def _dispensable(what: str, report: Reporter) -> Iterator[None]:
    """Context for making something that a run may lack."""
    try:
        yield
    except Interrupted:
        report.say(f"no {what}")
        raise
    except Exception as error:
        report.warn(f"no {what}: {type(error).__name__}: {error}")


def _write_products(program: Program, folder: RunFolder, state: Any, final: Evaluation, report: Reporter) -> None:
    """Result, policy file and pictures of one seed."""
    path, episodes = folder.path, final.episodes
    low, high = wilson_interval(final.successes_stochastic, episodes)
    report.say(
        f"{path}: iteration {final.iteration}, {final.env_steps / 1e6:.2f}M steps, success on rho_0 "
        f"{final.successes_stochastic / episodes:.3f} [{low:.3f}, {high:.3f}] "
        f"(mean action {final.successes_mean / episodes:.3f}), {episodes} episodes"
    )
    with _dispensable(f"policy.npz (python -m rcg_jax.export run={path} makes it later)", report):
        program.export(path, folder.config, state, final)
    with _dispensable(f"pictures of {path}", report):
        program.pictures(path)


def _write_report(program: Program, path: Path, report: Reporter, interrupts: Interrupts) -> None:
    """The report of one seed. Asked to stop, everything else is written."""
    with _dispensable(f"report.html (python -m rcg_jax.report run={path} writes it later)", report):
        with report.phase(f"writing {path / 'report.html'}") as tick:
            left_out = interrupts.call(lambda: program.report(path), finish=False, tick=tick)
        for line in left_out:
            report.say(line)


__all__ = ["RunError", "run"]
