"""What all experiments share: key=value arguments, a description of the machine, CSV files."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import functools
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rcg_jax.config.arguments import describe_arguments, parse_arguments
from rcg_jax.config.settings import ConfigError

Options = TypeVar("Options")

#: The committed CSV files and pictures.
RESULTS = Path(__file__).parent / "results"


def arguments(defaults: Mapping[str, Any]) -> dict[str, Any]:
    """``key=value`` arguments of this process, typed like ``defaults``; an unknown or unusable one exits with 2."""
    values = dict(defaults)
    for word in sys.argv[1:]:
        key, _, text = word.partition("=")
        if key not in values or not text:
            sys.exit(_fail(f"error: {word}: expected key=value with key one of {', '.join(defaults)}"))
        try:
            values[key] = type(defaults[key])(text)
        except ValueError:
            sys.exit(_fail(f"error: {word}: expected {type(defaults[key]).__name__}"))
    return values


def options(cls: type[Options], program: str) -> Options:
    """``key=value`` settings of this process as a dataclass of :func:`rcg_jax.config.settings.option` fields.

    ``-h`` prints them and exits; a wrong one exits with 2 and one line.
    """
    if "-h" in sys.argv[1:] or "--help" in sys.argv[1:]:
        settings = describe_arguments(cls, program).partition("\n\n")[2]
        print(f"usage: python -m {program} [name=value ...]\n\n{settings}")
        sys.exit(0)
    try:
        return parse_arguments(cls, sys.argv[1:])
    except ConfigError as error:
        sys.exit(_fail(f"error: {error}"))


def _fail(message: str) -> int:
    print(message, file=sys.stderr)
    return 2


def commit() -> str:
    """Short hash of the checkout, with + if its files differ from it; empty outside a checkout.

    The results do not count: what one run adds to them does not make the next one another program.
    """

    def git(*words: str) -> str:
        try:
            run = subprocess.run(["git", *words], capture_output=True, text=True, cwd=Path(__file__).parent)
        except OSError:  # no git here
            return ""
        return run.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":(exclude,top)experiments/results")
    return git("describe", "--always") + ("+" if changed else "")


def cpu_model() -> str:
    """What the processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    """Columns that say what a number was measured on, and with which command."""
    # Here, so that scripts which only read files do not wait for it.
    import jax
    import mujoco

    device = jax.devices()[0]
    spec = sys.modules["__main__"].__spec__
    return {
        "device": cpu_model() if device.platform == "cpu" else device.device_kind,
        "cpus": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "commit": commit(),
        "command": " ".join(["python -m", spec.name if spec else sys.argv[0], *sys.argv[1:]]),
    }


class ResultsError(ValueError):
    """A CSV file is not what these programs write: cut short, or another program's."""


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file.

    Raises:
        ResultsError: it is not whole, or no CSV file.
    """
    try:
        text = path.read_text()
    except UnicodeDecodeError:
        raise ResultsError(f"{path}: is no CSV file; git checkout brings the committed one back") from None
    reader = csv.DictReader(text.splitlines())
    rows = []
    for row in reader:
        if None in row or None in row.values():
            have, need = len([cell for cell in row.values() if cell is not None]), len(reader.fieldnames or [])
            raise ResultsError(f"{path}: line {reader.line_num} has not the {need} cells of the header ({have})")
        rows.append(row)
    if rows and not text.endswith("\n"):
        raise ResultsError(f"{path}: line {reader.line_num} is cut short")
    return rows


def require(path: Path, rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> None:
    """Refuses a file of other columns.

    Raises:
        ResultsError: names those that it lacks.
    """
    lacking = [name for name in columns if rows and name not in rows[0]]
    if lacking:
        raise ResultsError(
            f"{path}: lacks the columns {', '.join(lacking)}; python -m experiments.paper.collect writes them"
        )


def in_one_line(main: Callable[[], int]) -> Callable[[], int]:
    """A program that ends with 2 and one line when a setting cannot be used or a CSV file is damaged."""

    @functools.wraps(main)
    def guarded() -> int:
        try:
            return main()
        except (ConfigError, ResultsError) as error:
            return _fail(f"error: {error}")

    return guarded


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds a folder of CSV files while they are read, changed and written; waits for another process that does."""
    folder.mkdir(parents=True, exist_ok=True)
    # The file stays: one that is removed could be locked by a process that still waits for the old one.
    with (folder / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes ``rows`` as CSV; the file is replaced only when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = list(dict.fromkeys(key for row in rows for key in row))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, fields, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
