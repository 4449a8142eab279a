"""What a finished run makes of what it has saved: policy file, pictures, report. Failures are warnings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.interrupt import Interrupted, Interrupts
from rcg_jax.runs.program import Program
from rcg_jax.runs.progress import Reporter
from rcg_jax.runs.recorder import Evaluation


def write_products(program: Program, folder: RunFolder, state: Any, evaluation: Evaluation, report: Reporter) -> None:
    """Policy file and pictures of one seed.

    Args:
        program: makes them.
        folder: the seed's.
        state: its last train state.
        evaluation: its final one.
        report: is told what failed.
    """
    policy = partial(program.export, folder.path, folder.config, state, evaluation)
    _spare(f"policy.npz (python -m rcg_jax.export run={folder.path} makes it later)", policy, report)
    _spare(f"pictures of {folder.path}", partial(program.pictures, folder.path), report)


def _spare(what: str, make: Callable[[], None], report: Reporter) -> None:
    """Makes something that a run may lack."""
    try:
        make()
    except Exception as error:
        report.warn(f"no {what}: {type(error).__name__}: {error}")


def write_report(program: Program, folder: RunFolder, report: Reporter, interrupts: Interrupts) -> None:
    """The report of one seed.

    Raises:
        Interrupted: asked to stop; everything else is written.
    """
    what = f"report.html (python -m rcg_jax.report run={folder.path} writes it later)"
    try:
        with report.phase(f"writing {folder.path / 'report.html'}") as tick:
            left_out = interrupts.call(lambda: program.report(folder.path), finish=False, tick=tick)
    except Interrupted:
        report.say(f"no {what}")
        raise
    except Exception as error:
        report.warn(f"no {what}: {type(error).__name__}: {error}")
        return
    for line in left_out:
        report.say(line)
