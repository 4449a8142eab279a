"""Checkpoints of a whole train state: written atomically, verified by content when read.

A checkpoint is the folder ``checkpoints/<iteration>/``: ``state/`` as Orbax writes it, and ``manifest.json`` with the
SHA-256 of every file and of every array. It is written under a temporary name and renamed when it is complete, so a
folder with a number for a name is a whole checkpoint or one that was damaged later, which the digests show.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcg_jax.io.manifest import DamagedError, array_digest, brief, verify, write_manifest
from rcg_jax.runs.array_files import load_arrays, save_arrays

#: Checkpoints kept of a run.
KEEP = 3


class CheckpointError(RuntimeError):
    """No checkpoint can be used although there are some. The message says what to do; nothing was changed."""


class CheckpointWriteError(OSError):
    """A checkpoint could not be written. The existing ones are untouched."""


@dataclass(frozen=True)
class Damage:
    """A checkpoint that could not be used.

    Attributes:
        path: its folder.
        reason: what is wrong with it.
    """

    path: Path
    reason: str


@dataclass(frozen=True)
class Restored:
    """What :func:`restore` found.

    Attributes:
        iteration: iterations done.
        states: one train state per folder.
        damaged: newer checkpoints that could not be used.
    """

    iteration: int
    states: list[Any]
    damaged: list[Damage]


def _leaves(state: Any) -> dict[str, Any]:
    """Arrays of a pytree by name: PRNG keys as their data, and without empty arrays, which Orbax refuses."""
    named = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            is_abstract = isinstance(leaf, jax.ShapeDtypeStruct)
            leaf = jax.eval_shape(jax.random.key_data, leaf) if is_abstract else jax.random.key_data(leaf)
        if leaf.size:
            named[jax.tree_util.keystr(path).lstrip(".")] = leaf
    return named


def _key_impl(key: Any) -> Any:
    """Generator of a typed key, which may be only a shape: ``jax.random.key_impl`` asks for an array."""
    found: list[Any] = []
    jax.eval_shape(lambda traced: found.append(jax.random.key_impl(traced)), key)
    return found[0]


def _spec(leaves: dict[str, Any]) -> dict[str, str]:
    return {name: f"{np.dtype(leaf.dtype).name}{list(leaf.shape)}" for name, leaf in leaves.items()}


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
        if path.name.startswith(".replaced-"):
            # Interrupted between two renames: what was to be replaced is still the checkpoint.
            original = folder / path.name.removeprefix(".replaced-")
            if not original.exists():
                path.rename(original)
                continue
        if path.name.startswith((".new-", ".replaced-")):
            shutil.rmtree(path, ignore_errors=True)


def _write(folder: Path, iteration: int, state: Any) -> Path:
    """Writes a complete checkpoint under a temporary name; returns that."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".new-{iteration}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    arrays = {name: np.asarray(leaf) for name, leaf in jax.device_get(_leaves(state)).items()}
    save_arrays(temporary, arrays)
    digest = array_digest(arrays)
    if array_digest(load_arrays(temporary, arrays)) != digest:
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
    """Saves one state per folder, all or none, and keeps the newest :data:`KEEP` of each.

    Args:
        folders: ``checkpoints/`` folders, one per seed.
        iteration: iterations done.
        states: the seeds' train states.

    Raises:
        CheckpointWriteError: the disk is full or the like; what existed still exists.
    """
    written: list[Path] = []
    try:
        for folder, state in zip(folders, states, strict=True):
            written.append(folder / f".new-{iteration}")
            _write(folder, iteration, state)
        for temporary in written:
            _publish(temporary)
    except Exception as error:  # Orbax reports a full disk as one of several types
        for temporary in written:
            shutil.rmtree(temporary, ignore_errors=True)
        for folder in folders:
            clean(folder)
        raise CheckpointWriteError(brief(error)) from error
    for folder in folders:
        for old in iterations(folder)[:-KEEP]:
            shutil.rmtree(folder / str(old), ignore_errors=True)


def load(path: Path, like: Any) -> Any:
    """Reads one checkpoint.

    Args:
        path: the folder ``checkpoints/<iteration>``.
        like: a state of the same structure, or its shapes (``jax.eval_shape``).

    Returns:
        The state, on the default device.

    Raises:
        DamagedError: its content is not what was written.
        CheckpointError: it is intact, but of other arrays than ``like``, or of another version of Orbax.
    """
    body = verify(path)
    leaves = _leaves(like)
    wanted, found = _spec(leaves), body["arrays"]
    for name in [*wanted, *found]:
        if wanted.get(name) != found.get(name):
            raise CheckpointError(
                f"{path}: {name} is {found.get(name, 'absent')}, this program needs {wanted.get(name, 'none')}; "
                f"it was written by another version or with other settings"
            )
    try:
        arrays = load_arrays(path, leaves)
    except Exception as error:  # the files are those written, so this is no damage that an older one could mend
        raise CheckpointError(f"{path} is intact, but cannot be read: {brief(error)}") from error
    if array_digest(arrays) != body["array_sha256"]:
        raise DamagedError("arrays differ from those saved")

    def rebuild(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path).lstrip(".")
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.asarray(arrays[name]), impl=_key_impl(leaf))
        return jnp.asarray(arrays[name]) if name in arrays else jnp.zeros(leaf.shape, leaf.dtype)

    return jax.tree_util.tree_map_with_path(rebuild, like)


def restore(folders: Sequence[Path], like: Any) -> Restored | None:
    """Reads the newest iteration of which every folder has an intact checkpoint. Changes nothing on the disk.

    Args:
        folders: ``checkpoints/`` folders, one per seed.
        like: a state of the same structure, or its shapes.

    Returns:
        The states, or None where a run has none yet.

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
    if target.exists():
        shutil.rmtree(target, ignore_errors=True)
    damage.path.rename(target)
    return target
