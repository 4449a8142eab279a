"""``python -m rcg_jax.run`` without physics; method=uniform fails, method=all_starts is interrupted.

Each iteration takes at least as many seconds as the environment's FAKE_DELAY says.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from rcg_jax import run
from rcg_jax.config.settings import Config
from rcg_jax.runs import program
from rcg_jax.runs.interrupt import Interrupted
from rcg_jax.runs.program import Program
from tests.fake_program import load_fake


def load(config: Config, **_: Any) -> Program:
    if config.method == "uniform":
        raise ZeroDivisionError("something unforeseen")
    if config.method == "all_starts":
        raise Interrupted(15)
    return load_fake(config, float(os.environ.get("FAKE_DELAY", "0")))


if __name__ == "__main__":
    program.load_program = load
    sys.exit(run.main())
