"""Checkpoints of a whole train state: written atomically, verified by content when read.

A checkpoint is the folder ``checkpoints/<iteration>/``: ``state/`` as Orbax writes it, and ``manifest.json`` with the
SHA-256 of every file and of every array. It is written under a temporary name and renamed when it is complete, so a
folder with a number for a name is a whole checkpoint or one that was damaged later, which the digests show.
"""

from __future__ import annotations

import glob
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from rcg_jax.io.manifest import DamagedError, array_digest, brief, verify, write_manifest
from rcg_jax.sharding.keys import key_data, wrap_keys

#: Checkpoints kept of a run.
KEEP = 3


class CheckpointError(RuntimeError):
    """No checkpoint can be used although there are some. The message says what to do; nothing was changed."""


class CheckpointWriteError(OSError):
    """A checkpoint could not be written. The existing ones are untouched."""


class Damage(NamedTuple):
    """A checkpoint that could not be used: its folder, and what is wrong with it."""

    path: Path
    reason: str


class Restored(NamedTuple):
    """Iterations done, one train state per folder, and newer checkpoints that could not be used."""

    iteration: int
    states: list[Any]
    damaged: list[Damage]


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path).lstrip(".")


def _leaves(state: Any) -> dict[str, Any]:
    """Arrays of a pytree without keys by name; without empty ones, which Orbax refuses."""
    return {_name(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0] if leaf.size}


def _spec(leaves: dict[str, Any]) -> dict[str, str]:
    return {name: f"{np.dtype(leaf.dtype).name}{list(leaf.shape)}" for name, leaf in leaves.items()}


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


def _save_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays, none of them empty, to ``folder/state``; raises OSError, or one of Orbax's exceptions."""
    # A full disk is found out now, and not by Orbax in the middle.
    reserve = folder / "reserve"
    with reserve.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, 2 * sum(array.nbytes for array in arrays.values()) + 2**18)
    reserve.unlink()
    with _orbax(folder) as path:
        ocp.save(path, dict(arrays))


def _load_arrays(folder: Path, like: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Reads what :func:`_save_arrays` wrote; of each name, ``like`` has the shape and type."""
    with _orbax(folder) as path:
        return ocp.load(path, {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in like.items()})


def _sync(path: Path) -> None:
    """Waits until a file, or the entries of a folder, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def iterations(folder: Path) -> list[int]:
    """Iterations that ``folder`` (a run's ``checkpoints/``) has a checkpoint of, intact or not, in order."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal() and path.is_dir())


def clean(folder: Path) -> None:
    """Removes what an interrupted save left behind."""
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        original = folder / path.name.removeprefix(".replaced-")
        if not original.exists():  # between two renames: what was to be replaced is still the checkpoint
            path.rename(original)
        elif path.name.startswith((".new-", ".replaced-")):
            shutil.rmtree(path, ignore_errors=True)


def _write(folder: Path, iteration: int, state: Any) -> Path:
    """Writes a complete checkpoint under a temporary name; returns that."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".new-{iteration}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    arrays = {name: np.asarray(leaf) for name, leaf in jax.device_get(_leaves(key_data(state))).items()}
    _save_arrays(temporary, arrays)
    digest = array_digest(arrays)
    if array_digest(_load_arrays(temporary, arrays)) != digest:
        raise OSError("what was written reads back differently")
    write_manifest(temporary, {"arrays": _spec(arrays), "array_sha256": digest})
    for path in temporary.rglob("*"):
        _sync(path)
    _sync(temporary)
    return temporary


def _publish(temporary: Path) -> None:
    """Gives a complete checkpoint its name."""
    folder = temporary.parent
    final = folder / temporary.name.removeprefix(".new-")
    replaced = folder / f".replaced-{final.name}"
    if final.exists():
        final.rename(replaced)
    temporary.rename(final)
    _sync(folder)
    shutil.rmtree(replaced, ignore_errors=True)


def save(folders: Sequence[Path], iteration: int, states: Sequence[Any]) -> None:
    """Saves the states of all seeds, or none, in their folders ``checkpoints/``; keeps the newest :data:`KEEP` of each.

    Raises:
        CheckpointWriteError: the disk is full or the like; what existed still exists.
    """
    try:
        written = [_write(folder, iteration, state) for folder, state in zip(folders, states, strict=True)]
        for temporary in written:
            _publish(temporary)
    except Exception as error:  # Orbax reports a full disk as one of several types
        for folder in folders:
            with suppress(OSError):
                clean(folder)
        raise CheckpointWriteError(brief(error)) from error
    for folder in folders:
        for old in iterations(folder)[:-KEEP]:
            shutil.rmtree(folder / str(old), ignore_errors=True)


def load(path: Path, like: Any) -> Any:
    """Reads a checkpoint, of the structure of the state ``like``, or of its shapes, to the default device.

    Raises:
        DamagedError: its content is not what was written.
        CheckpointError: it is intact, but of other arrays than ``like``, or of another version of Orbax.
    """
    body = verify(path)
    shapes = jax.eval_shape(key_data, like)
    leaves = _leaves(shapes)
    wanted, found = _spec(leaves), body["arrays"]
    for name in {**wanted, **found}:
        if wanted.get(name) != found.get(name):
            raise CheckpointError(
                f"{path}: {name} is {found.get(name, 'absent')}, this program needs {wanted.get(name, 'none')}; "
                f"it was written by another version or with other settings"
            )
    try:
        arrays = _load_arrays(path, leaves)
    except Exception as error:  # the files are those written, so this is no damage that an older one could mend
        raise CheckpointError(f"{path} is intact, but cannot be read: {brief(error)}") from error
    if array_digest(arrays) != body["array_sha256"]:
        raise DamagedError("arrays differ from those saved")

    def read(path: Any, leaf: Any) -> Any:
        return jnp.asarray(arrays[_name(path)]) if leaf.size else jnp.zeros(leaf.shape, leaf.dtype)

    return wrap_keys(jax.tree_util.tree_map_with_path(read, shapes), like)


def restore(folders: Sequence[Path], like: Any) -> Restored | None:
    """Reads the newest iteration that all seeds have an intact checkpoint of; None where there is none at all.

    Changes nothing on the disk. See :func:`save` and :func:`load` for the arguments.

    Raises:
        CheckpointError: there are checkpoints, but none can be used, or the seeds are not at the same iteration.
    """
    listed = [iterations(folder) for folder in folders]
    common = sorted(set(listed[0]).intersection(*listed[1:]), reverse=True)
    newest = common[0] if common else 0
    for folder, own in zip(folders, listed, strict=True):
        # One more than the others is what a kill between the seeds' saves leaves; more is a seed's own history.
        if len([iteration for iteration in own if iteration > newest]) > 1:
            raise CheckpointError(
                f"{folder.parent} is at iteration {own[-1]}, another seed of this run at {newest}; "
                f"run the seeds alone (num_seeds=1) up to iterations={own[-1]}, then together"
            )
    damaged: list[Damage] = []
    for iteration in common:
        states = []
        for folder in folders:
            try:
                states.append(load(folder / str(iteration), like))
            except DamagedError as error:
                damaged.append(Damage(folder / str(iteration), str(error)))
        if len(states) == len(folders):
            return Restored(iteration=iteration, states=states, damaged=damaged)
    if damaged:
        reasons = "; ".join(f"{each.path}: {each.reason}" for each in damaged)
        raise CheckpointError(
            f"no intact checkpoint ({reasons}); nothing was changed: put back a copy of {folders[0]}, "
            f"or remove it to start this run over"
        )
    return None


def set_aside(damage: Damage) -> Path:
    """Renames a damaged checkpoint, so that it neither counts as one nor is lost; returns the new name."""
    target = damage.path.with_name(f"damaged-{damage.path.name}")
    shutil.rmtree(target, ignore_errors=True)
    damage.path.rename(target)
    return target
