"""``python -m rcg_jax.run`` without physics; method=uniform fails, method=all_starts is interrupted.

Each iteration takes at least as many seconds as the environment's FAKE_DELAY says.
"""

from __future__ import annotations

import functools
import os
import sys

from rcg_jax import run
from rcg_jax.config.settings import Config
from rcg_jax.runs import train as loop
from rcg_jax.runs.interrupt import Interrupted
from rcg_jax.runs.program import Program
from tests.fake_program import load_fake


def load(config: Config) -> Program:
    if config.method == "uniform":
        raise ZeroDivisionError("something unforeseen")
    if config.method == "all_starts":
        raise Interrupted(15)
    return load_fake(config, float(os.environ.get("FAKE_DELAY", "0")))


if __name__ == "__main__":
    loop.run = functools.partial(loop.run, load=load)  # type: ignore[assignment]
    sys.exit(run.main())
