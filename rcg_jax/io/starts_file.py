"""Files of feasible starts: one float32 array of positions in an npz, which knows its own hash.

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


def hash_qpos(qpos: np.ndarray) -> str:
    """SHA-256 (hex) of starts (C, nq): their shape, then the bytes of the rows as little-endian float32."""
    rows = np.ascontiguousarray(qpos, dtype="<f4")
    return hashlib.sha256(repr(rows.shape).encode() + rows.tobytes()).hexdigest()


def encode_starts(qpos: np.ndarray) -> bytes:
    """The content of a starts file: positions (C, nq) of starts at rest. The same starts give the same bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, qpos=np.asarray(qpos, np.float32), sha256=np.array(hash_qpos(qpos)))
    return buffer.getvalue()


def load_starts(path: Path | str) -> np.ndarray:
    """Positions (C, nq) float32, C >= 1, of a starts file.

    Raises:
        FileNotFoundError: there is no such file.
        StartsFileError: the file is damaged: unreadable, incomplete, or its content does not match its hash.
    """
    try:
        data = load_npz(Path(path).read_bytes(), _MOST)
        qpos, expected = data["qpos"], str(data["sha256"])
    except FileNotFoundError:
        raise
    except Exception as error:  # of numpy or zipfile: which one depends on the byte that is wrong
        raise _damaged(path, error) from None
    if qpos.dtype != np.float32 or qpos.ndim != 2 or not qpos.size:
        raise _damaged(path, f"starts of shape {qpos.shape}, type {qpos.dtype}")
    if hash_qpos(qpos) != expected:
        raise _damaged(path, "its content does not match its hash")
    return qpos


def starts_hash(path: Path | str) -> str:
    """Identity of a set of starts: :func:`hash_qpos` of what :func:`load_starts` finds."""
    return hash_qpos(load_starts(path))


def _damaged(path: Path | str, reason: object) -> StartsFileError:
    return StartsFileError(f"{path}: damaged file of starts ({one_line(reason, 160)}); restore it or generate it again")
