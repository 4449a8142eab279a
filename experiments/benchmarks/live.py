"""Two live lines on a terminal, a line now and then elsewhere: what is running, and how far all of it is."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import TextIO

#: Seconds between two looks at a process, and between two lines where the output is no terminal.
LOOK_S, LINE_S = 2.0, 60.0


def last_line(path: Path, begin: int = 0) -> str:
    """The last line of a log, from byte ``begin`` on, that says something; empty if none does."""
    try:
        with path.open("rb") as file:
            file.seek(max(begin, path.stat().st_size - 4_096))
            lines = file.read().decode(errors="replace").replace("\r", "\n").splitlines()
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


class Display:
    """Shows two lines that change; other lines go above them."""

    def __init__(self, out: TextIO | None = None) -> None:
        """Args: out defaults to the process's output."""
        self._out = sys.stdout if out is None else out
        self._live = self._out.isatty()
        self._shown: tuple[str, ...] = ()
        self._printed = float("-inf")

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: object) -> None:
        self._clear()
        self._out.flush()

    def _clear(self) -> None:
        if self._shown:
            # Up to the first of the lines, then erase to the end of the screen.
            self._out.write(f"\r\033[{len(self._shown)}A\033[J")
            self._shown = ()

    def say(self, line: str) -> None:
        """Prints a line that stays."""
        self._clear()
        print(line, file=self._out, flush=True)

    def show(self, *lines: str) -> None:
        """Shows what is now; on no terminal, once a minute."""
        if self._live:
            width = shutil.get_terminal_size().columns or 120
            self._clear()
            self._shown = tuple(line[: width - 1] for line in lines)
            self._out.write("".join(f"{line}\n" for line in self._shown))
            self._out.flush()
        elif time.monotonic() - self._printed >= LINE_S:
            self._printed = time.monotonic()
            print("  ".join(reversed(lines)), file=self._out, flush=True)
