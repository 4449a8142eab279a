"""Named arrays in Orbax's format, in a folder of any name and on a disk that may be full."""

from __future__ import annotations

import glob
import logging
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

_STATE = "state"


def _reserve(path: Path, size: int) -> None:
    """Finds out whether ``size`` bytes fit on the disk, before Orbax meets a full one in the middle.

    Raises:
        OSError: they do not.
    """
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, size)
    path.unlink()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps Orbax's threads from logging and printing an exception that it raises in the caller's thread, too."""
    logger = logging.getLogger("absl")
    level, hook = logger.level, threading.excepthook
    logger.setLevel(logging.CRITICAL)
    threading.excepthook = lambda args: None
    try:
        yield
    finally:
        logger.setLevel(level)
        threading.excepthook = hook


@contextmanager
def _alone() -> Iterator[None]:
    """Orbax without the other processes of a run, which leave all files to the first one.

    Orbax has a setting for that (``active_processes``), and asks all processes for their consent all the same.
    """
    with mock.patch.object(jax, "process_count", return_value=1):
        yield


@contextmanager
def _plain_path(path: Path) -> Iterator[Path]:
    """A name of the folder ``path`` without the characters that Orbax, which globs, takes for a pattern."""
    if not glob.has_magic(str(path.absolute())):
        yield path.absolute()
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "folder"
        link.symlink_to(path.absolute(), target_is_directory=True)
        yield link


def save_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays, none of them empty, to ``folder/state``.

    Raises:
        OSError: no room. Orbax has exceptions of its own, too.
    """
    _reserve(folder / "reserve", 2 * sum(array.nbytes for array in arrays.values()) + 2**18)
    with _quiet(), _alone(), _plain_path(folder) as plain:
        ocp.save(plain / _STATE, dict(arrays))


def load_arrays(folder: Path, like: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Reads arrays that :func:`save_arrays` wrote.

    Args:
        folder: the folder.
        like: for each name something with ``shape`` and ``dtype``.

    Raises:
        Exception: one of Orbax's many.
    """
    with _quiet(), _alone(), _plain_path(folder) as plain:
        return ocp.load(plain / _STATE, {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in like.items()})
