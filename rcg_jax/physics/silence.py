"""MuJoCo without its own messages: lines on the error stream, and a log file in the working directory."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco

_LOCK = threading.Lock()
_inside: list[Any] = []  # MuJoCo's settings from before the outermost context, once for each that is open


@contextmanager
def silence() -> Iterator[None]:
    """Context in which MuJoCo says nothing, of unstable simulations for instance: whoever steps them looks himself.

    MuJoCo's setting is the whole process's; contexts of several threads may overlap.
    """
    with _LOCK:
        before = _inside[0] if _inside else mujoco.MjLogConfig.get()
        _inside.append(before)
        silent = mujoco.MjLogConfig.get()
        silent.logto_console = silent.logto_file = False
        silent.set()
    try:
        yield
    finally:
        with _LOCK:
            _inside.pop()
            if not _inside:
                before.set()
