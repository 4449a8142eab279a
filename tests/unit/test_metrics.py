"""CSV files that survive kills and full disks; TensorBoard events that hide what was computed again."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from rcg_jax.io.tables import ColumnsError, CsvLog, TensorBoardLog, format_value

COLUMNS = ["iteration", "x"]


def log(path: Path, keep: int = 1000) -> CsvLog:
    return CsvLog(path, COLUMNS, keep=keep)


def fill(path: Path, last: int) -> None:
    one = log(path, keep=0)
    for k in range(1, last + 1):
        one.append({"iteration": k, "x": k / 7})


def test_floats_come_back_as_the_same_float32() -> None:
    for value in np.random.default_rng(0).normal(size=1000).astype(np.float32):
        assert np.float32(format_value(float(value))) == value


def test_rows_are_on_the_disk_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    one = log(path)
    for k in (1, 2):
        one.append({"x": 0.5, "iteration": k})
        assert path.read_text() == "iteration,x\n" + "".join(f"{i},0.5\n" for i in range(1, k + 1))


@pytest.mark.parametrize("cut", range(1, 14))
def test_a_row_cut_short_by_a_kill_is_dropped(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.csv"
    fill(path, 3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    one = log(path, keep=2)
    assert [row["iteration"] for row in one.kept] == ["1", "2"]
    one.append({"iteration": 3, "x": 3 / 7})
    assert path.read_bytes() == whole


def test_rows_after_the_resumed_iteration_are_dropped(tmp_path: Path) -> None:
    fill(tmp_path / "a.csv", 5)
    fill(tmp_path / "b.csv", 3)
    log(tmp_path / "a.csv", keep=3)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_dropping_rows_is_atomic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    fill(path, 5)
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            log(path, keep=3)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_other_columns_are_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("iteration,y\n1,2\n")
    with pytest.raises(ColumnsError, match="iteration,y"):
        log(path)
    assert path.read_text() == "iteration,y\n1,2\n"


def test_rows_wait_while_the_disk_is_full(tmp_path: Path) -> None:
    """The system takes part of a row, then there is no room."""
    path = tmp_path / "a.csv"
    fill(tmp_path / "whole.csv", 4)
    one = log(path)
    one.append({"iteration": 1, "x": 1 / 7})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 5, hard))
    try:
        for k in (2, 3):
            with pytest.raises(OSError, match="too large"):
                one.append({"iteration": k, "x": k / 7})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert one.pending == 2
    one.append({"iteration": 4, "x": 4 / 7})
    assert one.pending == 0
    assert path.read_bytes() == (tmp_path / "whole.csv").read_bytes()


def events(folder: Path) -> list[list[Event]]:
    """Events of each file, from the TFRecord framing: length, its checksum, data, its checksum."""
    result = []
    for path in sorted(folder.iterdir(), key=lambda each: each.stat().st_mtime_ns):
        content, found = path.read_bytes(), []
        while content:
            size = int.from_bytes(content[:8], "little")
            found.append(Event.FromString(content[12 : 12 + size]))
            content = content[16 + size :]
        result.append(found)
    return result


def test_tensorboard_gets_numbers_and_a_resumed_run_hides_what_follows(tmp_path: Path) -> None:
    first = TensorBoardLog(tmp_path, after=0)
    for k in (1, 2, 3):
        first.add(k, {"iteration": k, "x": k / 2, "text": "no", "none": None})
    TensorBoardLog(tmp_path, after=2).add(3, {"x": 7.0})
    old, new = events(tmp_path)
    scalars = [(event.step, value.tag, value.simple_value) for event in old for value in event.summary.value]
    assert [each for each in scalars if each[1] == "x"] == [(1, "x", 0.5), (2, "x", 1.0), (3, "x", 1.5)]
    assert {tag for _, tag, _ in scalars} == {"iteration", "x"}
    assert [event.step for event in new if event.HasField("session_log")] == [3]
