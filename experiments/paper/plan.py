"""Which runs the paper's curves need, and how they are trained on a kind of machine."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.config.names import METHODS, TASKS

#: The paper's number of seeds.
SEEDS = tuple(range(5))

#: The methods of the paper's figure 2; the oracle and self-play are in its point maze only.
LEARNING = ("uniform", "all_starts", "reverse")

#: Tasks of the paper's figures 3 and 5.
ARM = ("ring_peg", "key_insertion")

#: The setting of runs that S^0 guides, which the paper does not assume: half of the new starts are near draws of rho_0.
GUIDED = "curriculum.rho_0_share=0.5"


@dataclass(frozen=True, order=True)
class Curve:
    """What is drawn as one line; ``guided``: with :data:`GUIDED`."""

    task: str
    method: str
    reward: str = "sparse"
    preset: str = "default"
    guided: bool = False

    def __str__(self) -> str:
        extra = [f"reward={self.reward}"] * (self.reward != "sparse") + [f"preset={self.preset}"] * (
            self.preset != "default"
        )
        return " ".join([self.task, self.method, *extra, *([GUIDED] * self.guided)])


#: All curves of the figures: with our defaults, and with the paper's own values.
CURVES = (
    *(Curve(task, method) for task in TASKS for method in LEARNING),
    *(Curve("point_maze", method) for method in METHODS if method not in LEARNING),
    *(Curve(task, method, reward="distance") for task in ARM for method in ("uniform", "reverse")),
    *(Curve(task, method, preset="paper") for task in TASKS for method in LEARNING),
)


@dataclass(frozen=True)
class Budget:
    """How curves are trained on a kind of machine.

    Attributes:
        engine: physics engine.
        together: whether the seeds of a curve are one vmapped program.
        iterations: curriculum iterations by task, and of ``preset=paper``.
    """

    engine: str
    together: bool
    iterations: dict[str, int]


BUDGETS = {
    "cpu": Budget(
        "native", False, {"point_maze": 100, "ring_peg": 200, "key_insertion": 400, "ant_maze": 100, "paper": 80}
    ),
    "gpu": Budget(
        "mjx", True, {"point_maze": 200, "ring_peg": 1_000, "key_insertion": 1_000, "ant_maze": 125, "paper": 2_000}
    ),
}


@dataclass(frozen=True)
class Member:
    """One process: seeds of a curve, and its settings as on the command line."""

    curve: Curve
    seeds: tuple[int, ...]
    words: tuple[str, ...]

    @property
    def command(self) -> list[str]:
        """The process; the same one resumes it."""
        return [sys.executable, "-m", "rcg_jax.run", *self.words]

    @property
    def shown(self) -> str:
        """The same for people."""
        return shlex.join(["python", "-m", "rcg_jax.run", *self.words])


def members(
    budget: Budget, curves: Sequence[Curve], seeds: Sequence[int], run_dir: Path, extra: Sequence[str] = ()
) -> list[Member]:
    """The processes that train ``seeds`` of ``curves``, seed after seed, so that an early end leaves whole figures.

    Args:
        budget: how.
        curves: what.
        seeds: which; consecutive where they are one program.
        run_dir: folder of the runs; curves that share task, method and seed lie in different folders of it.
        extra: further settings, which win.
    """
    groups = [tuple(seeds)] if budget.together else [(seed,) for seed in seeds]
    return [
        Member(curve, group, tuple(_words(budget, curve, group, run_dir, extra)))
        for group in groups
        for curve in curves
    ]


def _words(budget: Budget, curve: Curve, seeds: tuple[int, ...], run_dir: Path, extra: Sequence[str]) -> list[str]:
    iterations = budget.iterations["paper" if curve.preset == "paper" else curve.task]
    ours = {
        "task": curve.task,
        "method": curve.method,
        "reward": curve.reward,
        "preset": curve.preset,
        "engine": budget.engine,
        "seed": seeds[0],
        "num_seeds": len(seeds),
        "iterations": iterations,
        "eval_every": max(1, iterations // 20),
        "run_dir": run_dir / f"{curve.preset}_{curve.reward}",
    }
    usual = {"reward": "sparse", "preset": "default", "num_seeds": 1}
    given = {word.partition("=")[0] for word in extra}
    return [f"{name}={value}" for name, value in ours.items() if usual.get(name) != value and name not in given] + [
        *extra
    ]
