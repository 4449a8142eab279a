"""What this machine computes on, asked in a process of its own so that the caller does not claim an accelerator.

python -m experiments.benchmarks.probe ring_peg point_maze       # prints JSON, with the tasks' horizons
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from rcg_jax.config.settings import ConfigError


def look(tasks: Sequence[str]) -> dict[str, Any]:
    """``platform``, ``count`` of its devices, the machine's columns of a CSV, and ``horizons`` of ``tasks``.

    Raises:
        ConfigError: one of the tasks cannot be made, or JAX finds no device; one line.
    """
    run = subprocess.run([sys.executable, "-m", "experiments.benchmarks.probe", *tasks], capture_output=True, text=True)
    if run.returncode:
        lines = run.stderr.strip().splitlines() or ["no reason given"]
        raise ConfigError(lines[-1])
    found = json.loads(run.stdout.splitlines()[-1])
    assert isinstance(found, dict)
    return found


def main() -> None:
    """Prints what it finds."""
    import jax

    from experiments.common import machine
    from rcg_jax.tasks import task_class

    horizons = {task: task_class(task).horizon for task in sys.argv[1:]}
    about = {key: str(value) for key, value in machine().items() if key != "command"}
    print(json.dumps({"platform": jax.default_backend(), "count": jax.device_count(), "horizons": horizons, **about}))


if __name__ == "__main__":
    main()
