"""Digests of arrays and of a folder's files, so that a changed, shortened or missing one is noticed."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from rcg_jax.io.console import one_line

_MANIFEST = "manifest.json"


class DamagedError(ValueError):
    """A checkpoint's content is not what was written; the message says where."""


def brief(error: BaseException) -> str:
    """An exception in one short line."""
    reason = re.search(
        r"No space left on device|Permission denied|Read-only file system|Disk quota exceeded", str(error)
    )
    return reason.group() if reason else one_line(error, 160)


def array_digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and contents."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name}:{arrays[name].dtype}{arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _body_digest(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def write_manifest(folder: Path, content: dict[str, Any]) -> None:
    """Writes ``manifest.json``: ``content``, and size and SHA-256 of every file in ``folder``."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    body = {
        **content,
        "files": {name: _file_digest(path) for name, path in files.items()},
        "sizes": {name: path.stat().st_size for name, path in files.items()},
    }
    (folder / _MANIFEST).write_text(json.dumps({"sha256": _body_digest(body), "body": body}, indent=1))


def _read_manifest(folder: Path) -> dict[str, Any]:
    try:
        stored = json.loads((folder / _MANIFEST).read_text())
        body = dict(stored["body"])
    except FileNotFoundError:
        raise DamagedError(f"{_MANIFEST} is missing") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{_MANIFEST} cannot be read: {brief(error)}") from None
    if stored.get("sha256") != _body_digest(body):
        raise DamagedError(f"{_MANIFEST} has changed")
    return body


def verify(folder: Path) -> dict[str, Any]:
    """Compares the files of ``folder`` with the manifest; returns its content.

    Raises:
        DamagedError: a file is missing, shorter, longer, or has changed.
    """
    body = _read_manifest(folder)
    for name, digest in body["files"].items():
        file, size = folder / name, body["sizes"][name]
        try:
            found, is_same = file.stat().st_size, _file_digest(file) == digest
        except FileNotFoundError:
            raise DamagedError(f"{name} is missing") from None
        except OSError as error:
            raise DamagedError(f"{name} cannot be read: {brief(error)}") from None
        if not is_same:
            raise DamagedError(f"{name} has {found} of {size} bytes" if found != size else f"{name} has changed")
    return body
