"""The streams that a command writes to, which may be closed, full, or in an encoding that lacks a letter."""

from __future__ import annotations

import io
import os
import site
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

_PACKAGE, _PYTHON = Path(__file__).parents[1], Path(os.__file__).parent


def one_line(what: object, most: int | None = None) -> str:
    """A text, or what an exception says, in one line of at most ``most`` characters."""
    return " ".join(str(what).split())[:most] or type(what).__name__


class Lenient:
    """A text stream whose errors are nobody's business: what a program prints must not end it.

    It may be closed, full, a terminal that went away, of an encoding that lacks a letter, or None, as Python has it
    where a program is started without.
    """

    def __init__(self, stream: TextIO | None) -> None:
        """Args: the stream."""
        self._stream = io.StringIO() if stream is None else stream

    def write(self, text: str) -> int:
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        with suppress(OSError, ValueError):
            self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def isatty(self) -> bool:
        with suppress(OSError, ValueError):
            return self._stream.isatty()
        return False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lenient_output() -> Iterator[None]:
    """Context in which printing never raises, whatever is behind the output and error streams."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(Lenient, before)  # type: ignore[assignment]
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before
        _keep_quiet_at_exit(before)


def tell(error: BaseException) -> None:
    """Prints an error in one line; above it, where code of the user's raised it, that code's traceback."""
    cause = error.__cause__
    trace = traceback.extract_tb(cause.__traceback__) if cause is not None else []
    if frames := [frame for frame in trace if _is_users(frame.filename)]:
        print("Traceback (most recent call last):", file=sys.stderr)
        print(f"{''.join(traceback.format_list(frames))}{type(cause).__name__}: {cause}", file=sys.stderr)
    print(f"error: {error}", file=sys.stderr, flush=True)


def _is_users(file: str) -> bool:
    """Whether a file belongs neither to this package, nor to an installed one, nor to Python."""
    path = Path(file)
    inside = any(path.is_relative_to(folder) for folder in (_PACKAGE, *map(Path, site.getsitepackages()), _PYTHON))
    return path.is_file() and not inside


def _keep_quiet_at_exit(streams: tuple[TextIO | None, TextIO | None]) -> None:
    """Python flushes its streams when it ends, and complains where that fails: what is left goes nowhere."""
    for stream in streams:
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[union-attr]
