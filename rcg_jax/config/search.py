"""Settings of the search for feasible starts (appendix A.2)."""

from __future__ import annotations

from dataclasses import dataclass

from rcg_jax.config.class_path import forms
from rcg_jax.config.names import ENGINES
from rcg_jax.config.settings import NOISES, option


@dataclass(frozen=True)
class FeasibleConfig:
    """How feasible starts are generated."""

    task: str = option("ring_peg", f"whose starts: {forms('task')}")
    engine: str = option("native", "physics", choices=ENGINES)
    seed: int = option(0, "random seed; the same settings give the same file", low=0, high=2**31 - 1)
    num_states: int = option(42_000, "starts to write: of more that were found, a random subset", low=1)
    num_found: int = option(0, "stop with this many starts; 0: num_states", low=0)
    max_rounds: int = option(500, "stop after this many rounds of walks, with fewer starts", low=1)
    num_walks: int = option(256, "walks per round, side by side", low=1)
    walk_length: int = option(1_000, "length of a walk", unit="steps", symbol="T_B", low=1)
    noise: str = option("integrated", "action noise of a walk", choices=NOISES)
    noise_std: float = option(1.0, "its standard deviation", symbol="Sigma^(1/2)", above=0)
    seeds: str = option(
        "visited", "walks begin in any state visited so far, or in the thinned starts", choices=("visited", "starts")
    )
    grid: float = option(0.2, "one start is kept per cell of this edge length in positions", unit="rad, m", above=0)
    max_depth: float = option(0.001, "starts overlap nothing deeper than this", unit="m", low=0)
    max_excess: float = option(0.01, "starts are beyond no joint's range by more than this", unit="rad, m", low=0)
    max_drift: float = option(0.1, "starts move by at most this under their neutral action", unit="rad, m", above=0)
    settle_steps: int = option(50, "for this long", unit="steps", low=0)
    out: str = option("", "file to write, *.npz, with a card *.json beside it; empty: the task's own")
    overwrite: str = option("false", "replace existing files", choices=("true", "false"))
