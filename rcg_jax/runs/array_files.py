"""Named arrays in Orbax's format, in a folder of any name and on a disk that may be full."""

from __future__ import annotations

import glob
import logging
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp


@contextmanager
def _orbax(folder: Path) -> Iterator[Path]:
    """Context for a call of Orbax; gives the path of ``folder/state`` in a form that it accepts."""
    logger, path = logging.getLogger("absl"), folder.absolute()
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    with ExitStack() as resources:
        resources.callback(logger.setLevel, level)
        # Its threads print exceptions that it raises in the caller's thread, too.
        resources.enter_context(mock.patch.object(threading, "excepthook"))
        # It asks all processes of a run for their consent, but only the first one writes.
        resources.enter_context(mock.patch.object(jax, "process_count", return_value=1))
        if glob.has_magic(str(path)):  # it globs, and would take the folder's name for a pattern
            link = Path(resources.enter_context(tempfile.TemporaryDirectory())) / "folder"
            link.symlink_to(path, target_is_directory=True)
            path = link
        yield path / "state"


def save_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays, none of them empty, to ``folder/state``.

    Raises:
        OSError: no room. Orbax has exceptions of its own, too.
    """
    # A full disk is found out now, and not by Orbax in the middle.
    reserve = folder / "reserve"
    with reserve.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, 2 * sum(array.nbytes for array in arrays.values()) + 2**18)
    reserve.unlink()
    with _orbax(folder) as path:
        ocp.save(path, dict(arrays))


def load_arrays(folder: Path, like: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Reads arrays that :func:`save_arrays` wrote.

    Args:
        folder: the folder.
        like: for each name something with ``shape`` and ``dtype``.

    Raises:
        Exception: one of Orbax's many.
    """
    with _orbax(folder) as path:
        return ocp.load(path, {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in like.items()})
