"""From how many starts does at least one of several policies arrive within T: what is the least that can be reached?

    python -m experiments.any_policy run=runs/ring_peg/reverse/seed0,runs/ring_peg/reverse/seed1
    python -m experiments.any_policy policy=first.npz,second.npz episodes=500

All policies, of one task, begin at the same starts, once with noise and once with their mean actions. Where one of
these episodes succeeds, the goal can be reached within T, since its actions do it: the share of such starts is a lower
bound of what a controller can reach, as ``experiments.ring_reach`` gives an upper one. ``any_policy.csv`` has a row per
task; rows of other tasks stay.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.report import RESULTS, in_one_line, machine, options
from experiments.trained import ACTIONS, fewer, merge, play, rate, subjects
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.physics.jit import enable_compilation_cache


@dataclass(frozen=True)
class AnyPolicyOptions:
    """Settings of ``python -m experiments.any_policy``."""

    policy: str = option("none", "shipped policies or files *.npz of one task, separated by commas")
    run: str = option("none", "instead of policy: folders of seeds, separated by commas")
    episodes: int = option(1_000, "starts; proportionally fewer where T is more than 500 steps", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    results: str = option(str(RESULTS), "folder of the CSV file")


def summary(successes: np.ndarray) -> dict[str, Any]:
    """Cells of the row.

    Args:
        successes: (P, A, E) bool, of P policies, A kinds of actions (:data:`ACTIONS`), E starts.
    """
    single = successes.mean(-1)
    plays = successes.reshape(-1, successes.shape[-1])
    return {
        "policies": len(successes),
        **rate(int(plays.any(0).sum()), plays.shape[-1]),
        "always": round(float(plays.all(0).mean()), 4),
        **{f"single_{name}": round(float(single[:, k].mean()), 4) for k, name in enumerate(ACTIONS)},
        **{f"best_{name}": round(float(single[:, k].max()), 4) for k, name in enumerate(ACTIONS)},
    }


def measure(chosen: AnyPolicyOptions) -> dict[str, Any]:
    """The row of these policies.

    Raises:
        ConfigError: one of them cannot be loaded, they are of several tasks, or there are no feasible starts.
    """
    if (chosen.policy == "none") == (chosen.run == "none"):
        raise ConfigError(f"policy={chosen.policy} run={chosen.run}: give one of them, with several policies of a task")
    many = chosen.run.split(",") if chosen.policy == "none" else []
    found = [one for run in many for one in subjects("all", run)] or subjects(chosen.policy, "none")
    loaded = [one.load() for one in found]
    if len(tasks := {run.task_name for run in loaded}) > 1:
        raise ConfigError(f"policies of {', '.join(sorted(tasks))}: must be of one task, to begin at the same starts")
    successes = []
    for k, (one, run) in enumerate(zip(found, loaded)):
        begin = time.monotonic()
        result = play(run, run.task, episodes=fewer(chosen.episodes, run.task.horizon), seed=chosen.seed)
        successes.append([getattr(result, name).success for name in ACTIONS])
        rates = "/".join(f"{np.mean(row):.3f}" for row in successes[-1])
        print(f"[{k + 1}/{len(found)}] {one.name}: {rates} ({time.monotonic() - begin:.0f} s)", flush=True)
    return {"policy": loaded[0].task_name, **summary(np.array(successes)), "seed": chosen.seed, **machine()}


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the CSV file for a page."""
    single = "a policy, on average: stochastic, mean action"
    lines = [
        f"| task | policies | starts | {single} | all episodes arrive | at least one arrives |",
        "|" + "---|" * 6,
    ]
    for row in rows:
        one, always = (float(row[column]) for column in ("single_stochastic", "always"))
        low, high = float(row["low"]), float(row["high"])
        lines.append(
            f"| {row['policy']} | {row['policies']} | {row['episodes']} | {one:.3f}, {float(row['single_mean']):.3f} "
            f"| {always:.3f} | {float(row['success']):.3f} [{low:.3f}, {high:.3f}] |"
        )
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Plays, writes and prints; returns the exit code."""
    chosen = options(AnyPolicyOptions, "experiments.any_policy")
    path = Path(chosen.results) / "any_policy.csv"
    enable_compilation_cache()
    rows = merge(path, [measure(chosen)])
    print(f"\n{markdown(rows)}\n\n{path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
