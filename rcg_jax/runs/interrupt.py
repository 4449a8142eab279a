"""Ctrl-C and termination: finish what is under way, save, stop; a second time stops at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

T = TypeVar("T")


class Interrupted(KeyboardInterrupt):
    """A run was asked to stop by the signal ``signum``, and everything that it keeps is saved."""

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum, self.exit_code = signum, 128 + signum  # as shells have it


@contextmanager
def handling(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Context in which ``handler`` gets SIGINT and SIGTERM; without effect outside of the main thread."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {signum: signal.signal(signum, handler) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for signum, previous in before.items():
            signal.signal(signum, previous)


class Interrupts:
    """Notes the first signal that :meth:`handle` is told of; the second one ends the process."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        """Args: notify is told what will happen, once."""
        self.signum: int | None = None
        self._notify = notify

    def handle(self, signum: int, frame: FrameType | None) -> None:
        """A handler of signals."""
        if self.signum is not None and "ipykernel" in sys.modules:
            raise KeyboardInterrupt  # the end of a cell, not of the notebook's kernel
        if self.signum is not None:
            # A compilation or a device program cannot be cancelled; files are whole at any moment.
            os._exit(128 + signum)
        self.signum = signum
        self._notify(f"{signal.Signals(signum).name}: stopping; once more stops at once")

    def call(self, fun: Callable[[], T], *, finish: bool, tick: Callable[[], None] = lambda: None) -> T:
        """Runs ``fun`` in a thread, so that signals are handled while it is inside compiled code.

        Args:
            fun: what to run; its exceptions are raised here.
            finish: wait for its end even when asked to stop.
            tick: called a few times per second meanwhile.

        Raises:
            Interrupted: asked to stop, and not ``finish``.
        """
        future: Future[T] = Future()

        def work() -> None:
            try:
                future.set_result(fun())
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        while wait([future], 0.25).not_done:
            if self.signum is not None and not finish:
                raise Interrupted(self.signum)
            tick()
        return future.result()
