"""What a finished run makes of what it has saved: policy file, pictures, report. Failures are warnings."""

from __future__ import annotations

from typing import Any

import jax

from rcg_jax.interrupt import Interrupted, Interrupts
from rcg_jax.program import Program
from rcg_jax.progress import Reporter
from rcg_jax.recorder import Evaluation
from rcg_jax.run_folder import RunFolder


def write_products(program: Program, folder: RunFolder, state: Any, evaluation: Evaluation, report: Reporter) -> None:
    """Policy file and pictures of one seed.

    Args:
        program: makes them.
        folder: the seed's.
        state: its last train state.
        evaluation: its final one.
        report: is told what failed.
    """
    try:
        program.export(folder.path, folder.config, jax.device_get(state), evaluation)
    except Exception as error:
        report.warn(
            f"no policy.npz in {folder.path}: {type(error).__name__}: {error}; "
            f"make it with python -m rcg_jax.export run={folder.path}"
        )
    try:
        program.pictures(folder.path)
    except Exception as error:
        report.warn(f"no pictures of {folder.path}: {type(error).__name__}: {error}")


def write_report(program: Program, folder: RunFolder, report: Reporter, interrupts: Interrupts) -> None:
    """The report of one seed.

    Raises:
        Interrupted: asked to stop; everything else is written.
    """
    again = f"python -m rcg_jax.report run={folder.path} writes it"
    try:
        with report.phase(f"writing {folder.path / 'report.html'}") as tick:
            left_out = interrupts.call(lambda: program.report(folder.path), finish=False, tick=tick)
    except Interrupted:
        report.say(f"no report of {folder.path}: {again}")
        raise
    except Exception as error:
        report.warn(f"no report of {folder.path}: {type(error).__name__}: {error}; {again}")
        return
    for line in left_out:
        report.say(line)
