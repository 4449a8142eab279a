"""What a finished run makes of what it has saved: policy file, pictures, report. Failures are warnings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.interrupt import Interrupted, Interrupts
from rcg_jax.runs.program import Program
from rcg_jax.runs.progress import Reporter
from rcg_jax.runs.recorder import Evaluation


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


def write_products(program: Program, folder: RunFolder, state: Any, evaluation: Evaluation, report: Reporter) -> None:
    """Policy file and pictures of one seed, from its last train state and its final evaluation."""
    with _dispensable(f"policy.npz (python -m rcg_jax.export run={folder.path} makes it later)", report):
        program.export(folder.path, folder.config, state, evaluation)
    with _dispensable(f"pictures of {folder.path}", report):
        program.pictures(folder.path)


def write_report(program: Program, folder: RunFolder, report: Reporter, interrupts: Interrupts) -> None:
    """The report of one seed.

    Raises:
        Interrupted: asked to stop; everything else is written.
    """
    with _dispensable(f"report.html (python -m rcg_jax.report run={folder.path} writes it later)", report):
        with report.phase(f"writing {folder.path / 'report.html'}") as tick:
            left_out = interrupts.call(lambda: program.report(folder.path), finish=False, tick=tick)
        for line in left_out:
            report.say(line)
