"""Scores the snapshots of one row of the race: success on rho_0 in C MuJoCo, stochastic and mean action.

    python -m experiments.race.score folder=runs/race/ring_peg/sac_her/seed0 task=ring_peg trainer=sac_her

Writes ``scores.csv`` into the folder, and goes on with one that is there. The race calls it, with the Python of the
row's trainer.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.common import in_one_line, options, read, write_rows
from experiments.race.entrants import ENTRANTS
from experiments.race.snapshots import Predict, snapshots, success
from rcg_jax.config.settings import option
from rcg_jax.gymnasium import make_vec
from rcg_jax.physics.jit import enable_compilation_cache


@dataclass(frozen=True)
class ScoreOptions:
    """Settings of ``python -m experiments.race.score``."""

    folder: str = option("", "of the row")
    task: str = option("ring_peg", "task")
    trainer: str = option("ours", "whose snapshots they are", choices=tuple(ENTRANTS))
    episodes: int = option(2_000, "episodes of each policy", low=1)
    seed: int = option(0, "of the starts", low=0)


@in_one_line
def main() -> int:
    """Scores every snapshot."""
    chosen = options(ScoreOptions, "experiments.race.score")
    enable_compilation_cache()
    folder = Path(chosen.folder)
    env = make_vec(chosen.task, chosen.episodes)
    feasible = np.asarray(env.starts.qpos)
    rows = np.random.default_rng(chosen.seed).permutation(len(feasible))[: chosen.episodes]
    starts = feasible[np.resize(rows, chosen.episodes)]
    load: Callable[..., Predict] = importlib.import_module(ENTRANTS[chosen.trainer].module).load
    path = folder / "scores.csv"
    about = {"episodes": str(chosen.episodes), "start_seed": str(chosen.seed)}
    scores = [row for row in (read(path) if path.exists() else []) if about.items() <= row.items()]
    known = {row["seconds"] for row in scores}
    for each in snapshots(folder / "snapshots"):
        if f"{each.seconds:.1f}" in known:
            continue
        predict = load(each.path, chosen.trainer, chosen.task)
        share = {kind: success(env, predict, starts, mean=kind == "mean") for kind in ("stochastic", "mean")}
        cells = {name: str(value) for name, value in share.items()}
        scores.append({"seconds": f"{each.seconds:.1f}", "env_steps": str(each.env_steps), **cells, **about})
        write_rows(path, sorted(scores, key=lambda row: float(row["seconds"])))
        print(
            f"{each.seconds:7.1f} s  {each.env_steps:>10,} steps  {share['stochastic']:.3f}  mean {share['mean']:.3f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
