"""MuJoCo without its own messages: lines on the error stream, and a log file in the working directory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def silence() -> Iterator[None]:
    """Context in which MuJoCo says nothing, of unstable simulations for instance: whoever steps them looks himself."""
    before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    silent.logto_console = silent.logto_file = False
    silent.set()
    try:
        yield
    finally:
        before.set()
