"""Runs one point of a sweep in a process of its own, and says how it ended."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from experiments.benchmarks.live import last_line

#: Seconds between two looks at the process and the machine's memory.
LOOK_S = 0.5

#: What programs say whose memory ran out.
_OUT_OF_MEMORY = re.compile(r"RESOURCE_EXHAUSTED|out of memory|OUT_OF_MEMORY|MemoryError|bad_alloc", re.IGNORECASE)

#: How much of a log is searched for it.
_TAIL_BYTES = 65_536


def available_gb() -> float:
    """Memory that the machine can still give [GiB]; infinite where the system does not say."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("MemAvailable"))
    return float("inf")


def environment() -> dict[str, str]:
    """Variables of a point: nothing is compiled from a cache."""
    return {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"}


def module(name: str, settings: Mapping[str, object]) -> list[str]:
    """The command of a module of this package with ``settings``."""
    return [sys.executable, "-m", f"experiments.{name}", *(f"{key}={value}" for key, value in settings.items())]


def _first_to_go() -> None:
    """If the system runs out of memory all the same, it should take this process and no other."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


def run(
    command: Sequence[str],
    log: Path,
    *,
    env: Mapping[str, str],
    timeout: float,
    spare_gb: float,
    show: Callable[[str], None],
) -> tuple[str, str]:
    """Runs a command to its end, or ends it.

    Args:
        command: what to run.
        log: file for its output.
        env: its environment.
        timeout: seconds that it may take.
        spare_gb: it is ended when the machine has less memory left than this [GiB].
        show: told its last line now and then.

    Returns:
        ``ok``, ``out of memory``, ``timed out``, ``killed``, ``refused`` (exit code 2) or ``failed``; and a line
        on why.
    """
    begin = time.monotonic()
    with log.open("wb") as out:
        process = subprocess.Popen(
            command,
            stdout=out,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=env,
            start_new_session=True,
            preexec_fn=_first_to_go,
        )
        try:
            while True:
                try:
                    code = process.wait(LOOK_S)
                    break
                except subprocess.TimeoutExpired:
                    show(last_line(log) or "starting")
                if time.monotonic() - begin > timeout:
                    return "timed out", f"after {timeout:g} s: {last_line(log)}"
                if (left := available_gb()) < spare_gb:
                    return "out of memory", f"ended when {left:.1f} GiB were left to the machine"
        finally:
            _end(process)
    line = last_line(log)
    if code == 0:
        return "ok", ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        found = _OUT_OF_MEMORY.search(file.read().decode(errors="replace"))
    if found:
        return "out of memory", line
    if code in (-signal.SIGKILL, 128 + signal.SIGKILL):
        return "killed", "by SIGKILL, as systems do that run out of memory"
    return ("refused" if code == 2 else "failed"), f"exit code {code}: {line}"


def _end(process: subprocess.Popen) -> None:
    """Ends it and whatever it started."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
