"""What a run was made with: ``provenance.json`` in a seed's folder, one entry per start of it."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from experiments.benchmarks.probe import look
from experiments.common import commit, cpu_model
from rcg_jax.config import ConfigError
from rcg_jax.io.tables import write_atomically

FILE = "provenance.json"

#: What an entry holds, in the order of ``runs.csv``; ``together``: the seeds of the process, which share its seconds.
FIELDS = ("together", "device", "cpus", "python", "jax", "mujoco", "commit")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def describe(together: int, *, on_cpu: bool = True) -> dict[str, Any]:
    """This machine and checkout, without importing JAX here, which would claim an accelerator.

    Args:
        together: seeds trained in one process.
        on_cpu: whether it computes on the CPU; otherwise JAX says on what, in a process of its own.
    """
    device = cpu_model()
    if not on_cpu:
        with contextlib.suppress(ConfigError):
            device = str(look(())["device"])
    return {
        "together": together,
        "device": device,
        "cpus": os.cpu_count(),
        "python": platform.python_version(),
        "jax": _version("jax"),
        "mujoco": _version("mujoco"),
        "commit": commit(),
    }


def record(folders: Sequence[Path], entry: dict[str, Any], iteration: int) -> None:
    """Adds an entry to seeds' folders, of the process that went on from ``iteration``; a warning where it cannot."""
    for folder in folders:
        entries = [*load(folder), {"from_iteration": iteration, **entry}]
        try:
            write_atomically(folder / FILE, (json.dumps(entries, indent=1) + "\n").encode())
        except OSError as error:
            print(f"warning: {folder / FILE} was not written: {error.strerror or error}", file=sys.stderr)


def load(folder: Path) -> list[dict[str, Any]]:
    """The entries of a seed's folder, oldest first; none where nothing was recorded."""
    try:
        entries = json.loads((folder / FILE).read_text())
    except (OSError, ValueError):
        return []
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def combined(folder: Path) -> dict[str, str]:
    """The fields of all entries of a folder; where a resumed run changed one, its values joined by `` then ``."""
    entries = load(folder)
    return {
        name: " then ".join(dict.fromkeys(str(entry.get(name, "")) for entry in entries if entry.get(name, "") != ""))
        for name in FIELDS
    }
