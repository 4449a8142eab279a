"""What a run shows: a live bar on a terminal, one plain line per iteration elsewhere."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TextIO

from tqdm import tqdm

from rcg_jax.io.console import Lenient, one_line


@dataclass(frozen=True)
class Progress:
    """One finished iteration; means over the seeds.

    Attributes:
        env_steps: environment steps so far, of one seed.
        steps_per_s: environment steps per second, of all seeds.
        success: on rho_i.
        start_distance: mean distance of the starts to the goal [m].
        evaluated: (iteration, success on rho_0) of the last evaluation.
    """

    iteration: int
    env_steps: int
    steps_per_s: float
    success: float
    share_good: float
    start_distance: float
    evaluated: tuple[int, float] | None


def duration(seconds: float) -> str:
    """1:02:03 or 02:03."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes:02}:{rest:02}"


def describe(progress: Progress) -> str:
    """The numbers of an iteration in one line."""
    rho_0 = "-" if progress.evaluated is None else f"{progress.evaluated[1]:.3f}@{progress.evaluated[0]}"
    return (
        f"{progress.env_steps / 1e6:.2f}M steps {progress.steps_per_s:,.0f}/s  rho_i {progress.success:.3f}  "
        f"rho_0 {rho_0}  good {progress.share_good:.2f}  dist {progress.start_distance:.3f} m"
    )


class Reporter:
    """Prints what a run does. Warnings go to the error stream, everything else to the output."""

    def __init__(self, out: TextIO | None = None, err: TextIO | None = None, *, quiet: bool = False) -> None:
        """By default with the process's own streams; a terminal gets a live bar. Quiet: warnings only."""
        self._out = Lenient(out or sys.stdout)
        self._err = Lenient(err or sys.stderr)
        self._quiet = quiet
        self._live = self._out.isatty() and not quiet
        self._bar: Any = None
        self._total = 0
        self._mean_s: float | None = None

    def say(self, line: str) -> None:
        """Prints a line, above the bar if there is one."""
        if not self._quiet:
            self._print(line, self._out)

    def warn(self, line: str) -> None:
        """Prints a warning, in one line."""
        self._print(f"warning: {one_line(line)}", self._err)

    def _print(self, line: str, stream: Lenient) -> None:
        tqdm.write(line, file=stream)
        stream.flush()

    @contextmanager
    def phase(self, name: str) -> Iterator[Callable[[], None]]:
        """Announces something that takes long; gives a function to call meanwhile, which shows the elapsed time."""
        start = time.monotonic()
        shown = 0.0
        inline = self._live and self._bar is None
        if not inline:
            self.say(f"{name} ...")

        def tick() -> None:
            nonlocal shown
            elapsed = time.monotonic() - start
            if inline:
                print(f"\r{name} ... {elapsed:.0f} s ", end="", file=self._out, flush=True)
            elif elapsed - shown >= 15.0:
                shown = elapsed
                self.say(f"{name} ... {elapsed:.0f} s")

        if inline:
            tick()
        try:
            yield tick
        finally:
            self.say(f"{chr(13) if inline else ''}{name}: {time.monotonic() - start:.1f} s")

    def begin(self, done: int, total: int) -> None:
        """Starts the bar at iteration ``done`` of ``total``."""
        self._total = total
        if self._live:
            layout = "{n_fmt}/{total_fmt} |{bar:8}| {elapsed}<{remaining}  {desc}"
            # Some terminals (containers) say that they are 0 columns wide; on those a bar would be empty.
            with suppress(OSError, ValueError):
                known = os.get_terminal_size(self._out.fileno()).columns > 0
                size = {"dynamic_ncols": True} if known else {"ncols": 120, "nrows": 24}
                self._bar = tqdm(total=total, initial=done, file=self._out, bar_format=layout, **size)

    def tick(self) -> None:
        """Keeps the bar's clock going during an iteration."""
        if self._bar is not None:
            self._bar.refresh()

    def iteration(self, progress: Progress, seconds: float) -> None:
        """Shows a finished iteration that took ``seconds``."""
        self._mean_s = seconds if self._mean_s is None else 0.8 * self._mean_s + 0.2 * seconds
        if self._bar is not None:
            self._bar.set_description_str(describe(progress), refresh=False)
            self._bar.update(1)
        else:
            left = duration(self._mean_s * (self._total - progress.iteration))
            self.say(f"iteration {progress.iteration}/{self._total}  {describe(progress)}  ETA {left}")

    def end(self) -> None:
        """Ends the bar; its last state stays on the screen."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
