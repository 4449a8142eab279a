"""Files of feasible starts: a float32 array of positions in an npz, which knows its own hash; of models whose actuators
have activations, an array of those, too.

The hash covers the numbers, not the zip container around them, so it stays the same whatever wrote the file.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np

from rcg_jax.io.console import one_line
from rcg_jax.io.npz import load_npz

#: Bytes that a set of starts may take: ten million of 25 positions.
_MOST = 10**9


class StartsFileError(ValueError):
    """A file that holds no intact set of starts. The message is one line: file, what is wrong, what to do."""


def hash_starts(qpos: np.ndarray, act: np.ndarray | None = None) -> str:
    """SHA-256 (hex) of starts (C, nq) and, in the same way after them, of their activations (C, na), if any."""
    digest = hashlib.sha256()
    for array in (qpos,) if act is None or not act.size else (qpos, act):
        rows = np.ascontiguousarray(array, dtype="<f4")
        digest.update(repr(rows.shape).encode() + rows.tobytes())
    return digest.hexdigest()


def encode_starts(qpos: np.ndarray, act: np.ndarray | None = None) -> bytes:
    """The content of a starts file: positions (C, nq) of starts at rest, and their activations (C, na), if any.

    The same starts give the same bytes.
    """
    arrays = {"qpos": np.asarray(qpos, np.float32)}
    if act is not None and act.size:
        arrays["act"] = np.asarray(act, np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, sha256=np.array(hash_starts(qpos, act)))  # type: ignore[arg-type]
    return buffer.getvalue()


def load_states(
    path: Path | str, *, nq: int | None = None, na: int | None = None, of: str = ""
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (C, nq) and activations (C, na) float32, C >= 1 and na >= 0, of a starts file.

    Raises:
        StartsFileError: it has other numbers of them than ``nq`` and ``na``, those of the task ``of``, if given.
        FileNotFoundError: there is no such file.
        StartsFileError: the file is damaged: unreadable, incomplete, or its content does not match its hash.
    """
    try:
        data = load_npz(Path(path).read_bytes(), _MOST)
        qpos, expected = data["qpos"], str(data["sha256"])
        act = data.get("act", np.zeros((len(qpos), 0), np.float32))
    except FileNotFoundError:
        raise
    except Exception as error:  # of numpy or zipfile: which one depends on the byte that is wrong
        raise _damaged(path, error) from None
    for array in (qpos, act):
        if array.dtype != np.float32 or array.ndim != 2 or len(array) != len(qpos) or not qpos.size:
            raise _damaged(path, f"starts of shape {array.shape}, type {array.dtype}")
    if hash_starts(qpos, act) != expected:
        raise _damaged(path, "its content does not match its hash")
    for what, found, own in (("positions", qpos, nq), ("activations", act, na)):
        if own not in (None, found.shape[1]):
            raise StartsFileError(f"{path}: {found.shape[1]} {what} per start, {of} has {own}")
    return qpos, act


def starts_hash(path: Path | str) -> str:
    """Identity of a set of starts: :func:`hash_starts` of what :func:`load_states` finds."""
    return hash_starts(*load_states(path))


def _damaged(path: Path | str, reason: object) -> StartsFileError:
    return StartsFileError(f"{path}: damaged file of starts ({one_line(reason, 160)}); restore it or generate it again")
