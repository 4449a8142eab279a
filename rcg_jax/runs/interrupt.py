"""Ctrl-C and termination: finish what is under way, save, stop; a second time stops at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self, TypeVar

T = TypeVar("T")


class Interrupted(KeyboardInterrupt):
    """A run was asked to stop, and everything that it keeps is saved.

    Attributes:
        signum: the signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum

    @property
    def exit_code(self) -> int:
        """128 + signal, as shells have it."""
        return 128 + self.signum


class Interrupts:
    """Context in which SIGINT and SIGTERM are only noted; the second one ends the process."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        """Args: notify is told what will happen, once."""
        self.signum: int | None = None
        self._notify = notify
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Python allows handlers in the main thread only; a run inside another thread goes without.
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._previous[signum] = signal.signal(signum, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for signum, handler in self._previous.items():
            signal.signal(signum, handler)

    def _handle(self, signum: int, frame: FrameType | None) -> None:
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
            fun: what to run.
            finish: wait for its end even when asked to stop.
            tick: called a few times per second meanwhile.

        Returns:
            Its result; its exceptions are raised here.

        Raises:
            Interrupted: asked to stop, and not ``finish``.
        """
        results: list[T] = []
        errors: list[BaseException] = []
        done = threading.Event()

        def work() -> None:
            try:
                results.append(fun())
            except BaseException as error:  # raised again in the caller's thread
                errors.append(error)
            finally:
                done.set()

        threading.Thread(target=work, daemon=True).start()
        while not done.wait(0.25):
            if self.signum is not None and not finish:
                raise Interrupted(self.signum)
            tick()
        if errors:
            raise errors[0]
        return results[0]
