"""Whether a program fits into memory, before it is run."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from rcg_jax.config.settings import Config


def shortage(compiled: Any, config: Config) -> str:
    """What to say where a compiled train step needs more memory than there is, with the settings; empty if it fits."""
    try:
        needs = compiled.memory_analysis()
        needed = int(needs.temp_size_in_bytes + needs.output_size_in_bytes)
    except Exception:  # not every backend knows
        return ""
    free = free_memory()
    if free is None or needed <= free:
        return ""
    return (
        f"one train step needs {needed / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB are free; it grows with "
        f"rollout.batch_size={config.rollout.batch_size}, rollout.num_envs={config.rollout.num_envs}, "
        f"curriculum.num_candidates={config.curriculum.num_candidates}, "
        f"curriculum.stall_walk={config.curriculum.stall_walk}, num_seeds={config.num_seeds}, "
        "and with the task's horizon, the steps of an episode"
    )


def free_memory() -> int | None:
    """Bytes that a program can still have, of the machine or of its accelerator; None where nobody says."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0)) if "bytes_limit" in stats else None
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    return min([*found, *_of_container()], default=None)


def _of_container() -> list[int]:
    """What the control group of a container leaves, where there is one with a limit."""
    for group, limit, used in (
        ("/sys/fs/cgroup", "memory.max", "memory.current"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
        with suppress(OSError, ValueError):  # none, or "max"
            free = int(Path(group, limit).read_text()) - int(Path(group, used).read_text())
            parts = dict(line.split() for line in Path(group, "memory.stat").read_text().splitlines())
            return [free + int(parts.get("inactive_file", 0))]  # files that the kernel keeps while there is room
    return []
