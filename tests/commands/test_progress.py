"""What a run shows, on a terminal and elsewhere."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import struct
import termios
from contextlib import suppress

import pytest

from rcg_jax.runs.progress import Progress, Reporter

SHOWN = Progress(
    iteration=3,
    env_steps=750_000,
    steps_per_s=14_512.3,
    success=0.521,
    share_good=0.43,
    start_distance=0.123,
    evaluated=(2, 0.31),
)


def read_all(master: int) -> str:
    """What was written to a pseudo-terminal whose other end is closed; one read may return less than all."""
    parts = []
    with suppress(OSError):  # EIO: the end
        while part := os.read(master, 1 << 16):
            parts.append(part)
    return b"".join(parts).decode()


def test_elsewhere_it_is_one_plain_line_per_iteration() -> None:
    out, err = io.StringIO(), io.StringIO()
    report = Reporter(out, err)
    report.begin(2, 10)
    report.iteration(SHOWN, 30.0)
    report.end()
    (line,) = out.getvalue().splitlines()
    for part in ("3/10", "0.75M", "14,512/s", "0.521", "0.310", "0.43", "0.123 m", "ETA 03:30"):
        assert part in line, part
    assert err.getvalue() == ""


def test_a_warning_is_one_line_on_the_error_stream() -> None:
    out, err = io.StringIO(), io.StringIO()
    Reporter(out, err).warn("two\nlines")
    assert out.getvalue() == ""
    assert err.getvalue() == "warning: two lines\n"


@pytest.mark.parametrize("columns", [0, 120])
def test_on_a_terminal_it_is_a_bar(columns: int) -> None:
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24 if columns else 0, columns, 0, 0))
    with open(slave, "w", encoding="utf-8") as out:
        report = Reporter(out, io.StringIO())
        with report.phase("compiling the train step") as tick:
            tick()
        report.begin(2, 10)
        report.iteration(SHOWN, 30.0)
        report.say("a line above")
        report.end()
    shown = read_all(master)
    os.close(master)
    assert "compiling the train step ... 0 s" in shown
    for part in ("3/10", "0.75M", "14,512/s", "0.521", "0.310@2", "0.43", "0.123 m", "a line above"):
        assert part in shown, part


def test_a_closed_pipe_does_not_end_a_run() -> None:
    read, write = os.pipe()
    os.close(read)
    out = open(write, "w")  # noqa: SIM115
    Reporter(out, io.StringIO()).say("nobody listens")
    # The buffer still holds the text, which closing would try to write once more.
    with pytest.raises(BrokenPipeError):
        out.close()


def test_a_terminal_that_went_away_does_not_end_a_run() -> None:
    master, slave = pty.openpty()
    with suppress(OSError), open(slave, "w", encoding="utf-8") as out:
        report = Reporter(out, io.StringIO())
        os.close(master)
        with report.phase("compiling the train step") as tick:
            tick()
        report.begin(2, 10)
        report.tick()
        report.iteration(SHOWN, 30.0)
        report.end()
        done = True
    assert done
