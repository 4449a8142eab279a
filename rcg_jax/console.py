"""The streams that a command writes to, which may be closed, full, or in an encoding that lacks a letter."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO


class _Lenient:
    """A text stream whose errors are nobody's business: what a program prints must not end it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        with suppress(OSError, ValueError):
            self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


@contextmanager
def lenient_output() -> Iterator[None]:
    """Context in which printing never raises, whatever is behind the output and error streams."""
    before = sys.stdout, sys.stderr
    nowhere = open(os.devnull, "w") if None in before else None  # noqa: SIM115
    sys.stdout, sys.stderr = (_Lenient(stream or nowhere) for stream in before)  # type: ignore[assignment,arg-type]
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before
        _keep_quiet_at_exit(before)


def _keep_quiet_at_exit(streams: tuple[TextIO | None, TextIO | None]) -> None:
    """Python flushes its streams when it ends, and complains where that fails: what is left goes nowhere."""
    for stream in streams:
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[union-attr]
