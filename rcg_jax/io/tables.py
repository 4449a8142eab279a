"""What a run writes down: CSV files that survive a kill, and TensorBoard events."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar


class ColumnsError(RuntimeError):
    """A CSV file has other columns than this program writes."""


#: A cell of a row; None leaves it empty.
Value = int | float | str | None


def format_value(value: Value) -> str:
    """A cell. Nine digits give back the same float32."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.9g}"
    return str(int(value)) if isinstance(value, int) else value


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces a file as a whole: a reader, or a kill at any moment, sees the old or the new content.

    Raises:
        OSError: it could not be written; the old content is still there.
    """
    temporary = path.with_name(f".{path.name}.new")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and complete rows of a CSV file; a last line cut short by a kill is left out."""
    if not path.exists():
        return [], []
    text = path.read_bytes().decode(errors="replace")
    lines = [line.split(",") for line in text.split("\n")[:-1]]
    if not lines:
        return [], []
    return lines[0], [cells for cells in lines[1:] if len(cells) == len(lines[0])]


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Number columns of a CSV file by name, each (rows,); empty where there is no row. Empty cells become NaN."""
    header, rows = read_csv(path)
    columns = {}
    for name, cells in zip(header, zip(*rows, strict=True), strict=False):
        with contextlib.suppress(ValueError):  # text, such as a hash
            columns[name] = np.array([float(cell or "nan") for cell in cells])
    return columns


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Value]]) -> None:
    """Writes a CSV file with :func:`write_atomically`."""
    lines = [",".join(columns), *(",".join(map(format_value, row)) for row in rows)]
    write_atomically(path, "".join(f"{line}\n" for line in lines).encode())


class CsvLog:
    """A CSV file with one row per iteration, appended durably.

    A row that cannot be written (a full disk) stays in memory and is written, in order, with the next one.

    Attributes:
        path: the file.
        columns: its header; the first column is the iteration.
        kept: the rows that were there when the file was opened, by column.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, keep: int) -> None:
        """Opens the file, or makes it, and drops the rows after iteration ``keep``: a resumed run writes them again.

        Raises:
            OSError: it cannot be written.
            ColumnsError: it has other columns.
        """
        self.path, self.columns = path, list(columns)
        self._pending: list[str] = []
        header, rows = read_csv(path)
        if header and header != self.columns:
            raise ColumnsError(f"{path} has the columns {','.join(header)}, this program writes {','.join(columns)}")
        rows = [row for row in rows if row[0].isdecimal() and int(row[0]) <= keep]
        self.kept = [dict(zip(self.columns, row, strict=True)) for row in rows]
        data = "".join(",".join(row) + "\n" for row in [self.columns, *rows]).encode()
        if not path.exists() or path.read_bytes() != data:
            write_atomically(path, data)
        self._size = len(data)

    @property
    def pending(self) -> int:
        """Rows that are not on the disk yet."""
        return len(self._pending)

    def append(self, row: Mapping[str, Value]) -> None:
        """Adds a row and forces it to the disk; after an OSError the row is kept for the next call."""
        self._pending.append(",".join(format_value(row[name]) for name in self.columns) + "\n")
        self.flush()

    def flush(self) -> None:
        """Writes pending rows."""
        data = "".join(self._pending).encode()
        try:
            with self.path.open("r+b") as file:
                # What a failed attempt left behind the last whole row goes first.
                file.truncate(self._size)
                file.seek(self._size)
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            with contextlib.suppress(OSError):  # if not now, the next attempt truncates, and so does a resumed run
                os.truncate(self.path, self._size)
            raise
        self._size += len(data)
        self._pending.clear()


class TensorBoardLog:
    """Scalars for TensorBoard, written at once: no queue that could block or lose them."""

    def __init__(self, folder: Path, *, after: int) -> None:
        """Prepares a new events file in ``folder``; what earlier ones hold beyond iteration ``after`` is hidden."""
        self._folder, self._after = folder, after
        self._writer: EventsWriter | None = None

    def add(self, iteration: int, values: Mapping[str, Value]) -> None:
        """Writes the numbers among ``values``; after an OSError the next call begins a new file."""
        try:
            if self._writer is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._writer = EventsWriter(str(self._folder / "events"), f".{os.getpid()}.{time.monotonic_ns()}")
                start = SessionLog(status=SessionLog.START)
                self._writer.write_event(Event(wall_time=time.time(), step=self._after + 1, session_log=start))
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    event = Event(wall_time=time.time(), step=iteration, summary=scalar(name, value))
                    self._writer.write_event(event)
            self._writer.flush()
        except OSError:
            self._writer = None
            self._after = iteration
            raise

    def close(self) -> None:
        """Closes the file; all is written already."""
        if self._writer is not None:
            with contextlib.suppress(OSError):
                self._writer.close()
            self._writer = None
