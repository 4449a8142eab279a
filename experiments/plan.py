"""Which runs the paper's curves need.

A *curve* is a task, a method, a reward and a preset; it needs :data:`SEEDS` seeds. A *budget* says how each curve is
trained on a kind of machine. A *member* is one process: one seed of a curve where a CPU trains, all seeds of it in one
vmapped program on an accelerator. Nothing here uses a device: those are for the processes.
"""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.config.names import METHODS, TASKS
from rcg_jax.config.settings import Config
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.task_settings import training_config

#: The paper's number of seeds.
SEEDS = tuple(range(5))

#: Time of an iteration relative to the other methods (results/method_cost_point_maze.csv): the oracle labels its
#: starts with episodes of their own, self-play has Alice's and Bob's.
FACTORS = {"oracle": 3.0, "self_play": 2.0}

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

    @property
    def folder(self) -> str:
        """Where its runs lie below the folder of a budget: those of one folder differ in task, method and seed."""
        return f"{self.preset}_{self.reward}"

    def __str__(self) -> str:
        extra = [f"reward={self.reward}"] * (self.reward != "sparse") + [f"preset={self.preset}"] * (
            self.preset != "default"
        )
        extra += [GUIDED] * self.guided
        return " ".join([self.task, self.method, *extra])


#: All curves of the figures, with our defaults.
CURVES = (
    *(Curve(task, method) for task in TASKS for method in LEARNING),
    *(Curve("point_maze", method) for method in METHODS if method not in LEARNING),
    *(Curve(task, method, reward="distance") for task in ARM for method in ("uniform", "reverse")),
)

#: The paper's own values: what its published curves are compared with.
PAPER = tuple(Curve(task, method, preset="paper") for task in TASKS for method in LEARNING)


@dataclass(frozen=True)
class Length:
    """How long a task is trained.

    Attributes:
        iterations: curriculum iterations.
        eval_every: iterations between evaluations.
        seconds: estimate of an iteration of one member, evaluations included, for a method of factor 1 in
            :data:`FACTORS` [s]; None: nobody has measured it.
    """

    iterations: int
    eval_every: int
    seconds: float | None = None


@dataclass(frozen=True)
class Budget:
    """How curves are trained on a kind of machine.

    Attributes:
        engine: physics engine.
        together: whether the seeds of a curve are one vmapped program.
        curves: what is trained.
        lengths: by task.
        paper: of the curves with preset=paper.
    """

    engine: str
    together: bool
    curves: tuple[Curve, ...]
    lengths: dict[str, Length]
    paper: Length | None = None

    def length(self, curve: Curve) -> Length:
        """That of a curve."""
        return self.paper if self.paper and curve.preset == "paper" else self.lengths[curve.task]


BUDGETS = {
    "cpu": Budget(
        engine="native",
        together=False,
        curves=CURVES + PAPER,
        lengths={
            "point_maze": Length(100, 10, 1.2),
            "ring_peg": Length(200, 10, 1.4),
            "key_insertion": Length(400, 20, 1.6),
            "ant_maze": Length(50, 5, 15.0),
        },
        paper=Length(80, 8, 7.0),  # 20 million steps; the paper trains for 2,000 iterations
    ),
    "gpu": Budget(
        engine="mjx",
        together=True,
        curves=CURVES + PAPER,
        lengths={
            "point_maze": Length(200, 10),
            "ring_peg": Length(1_000, 50),
            "key_insertion": Length(1_000, 50),
            "ant_maze": Length(125, 5),
        },
        paper=Length(2_000, 20),
    ),
}


@dataclass(frozen=True)
class Member:
    """One process.

    Attributes:
        curve: what it trains.
        config: its settings.
        words: what they are on the command line.
    """

    curve: Curve
    config: Config
    words: tuple[str, ...]

    @property
    def name(self) -> str:
        """In a table."""
        last = self.config.seed + self.config.num_seeds - 1
        return f"{self.curve} " + (
            f"seed={self.config.seed}" if last == self.config.seed else f"seeds={self.config.seed}..{last}"
        )

    @property
    def command(self) -> list[str]:
        """The process; the same one resumes it."""
        return [sys.executable, "-m", "rcg_jax.run", *self.words]

    @property
    def shown(self) -> str:
        """The same for people."""
        return shlex.join(["python", "-m", "rcg_jax.run", *self.words])

    @property
    def folders(self) -> list[RunFolder]:
        """One per seed."""
        return [RunFolder(self.config, self.config.seed + k) for k in range(self.config.num_seeds)]


def blocks(seeds: Iterable[int]) -> Iterator[tuple[int, int]]:
    """(first, number) of the runs of consecutive numbers among ``seeds``."""
    rest = sorted(set(seeds))
    while rest:
        count = next((k for k in range(len(rest)) if rest[k] != rest[0] + k), len(rest))
        yield rest[0], count
        rest = rest[count:]


def words(
    budget: Budget, curve: Curve, run_dir: Path, *, method: str = "", seeds: str, extra: Sequence[str]
) -> list[str]:
    """Settings of ``python -m rcg_jax.run`` for a curve; ``extra`` ones come last and win."""
    length = budget.length(curve)
    ours = [
        f"task={curve.task}",
        f"method={method or curve.method}",
        *([f"reward={curve.reward}"] if curve.reward != "sparse" else []),
        *([f"preset={curve.preset}"] if curve.preset != "default" else []),
        f"engine={budget.engine}",
        seeds,
        f"iterations={length.iterations}",
        f"eval_every={length.eval_every}",
        f"run_dir={run_dir / curve.folder}",
    ]
    replaced = {word.partition("=")[0] for word in extra}
    return [word for word in ours if word.partition("=")[0] not in replaced] + list(extra)


def members(
    budget: Budget, curves: Sequence[Curve], seeds: Sequence[int], run_dir: Path, extra: Sequence[str] = ()
) -> list[Member]:
    """The processes that train ``seeds`` of ``curves``, seed after seed, so that an early end leaves whole figures.

    Raises:
        ConfigError: an extra setting that cannot be used.
    """
    out = []
    for first, count in list(blocks(seeds)) if budget.together else [(seed, 1) for seed in sorted(set(seeds))]:
        for curve in curves:
            together = f"seed={first}" + (f" num_seeds={count}" if count > 1 else "")
            own = words(budget, curve, run_dir, seeds="seed=0", extra=extra)
            config = dataclasses.replace(_compose(tuple(own)), seed=first, num_seeds=count)
            own[own.index("seed=0") : own.index("seed=0") + 1] = together.split()
            out.append(Member(curve, config, tuple(own)))
    return out


_composed: dict[tuple[str, ...], Config] = {}


def _compose(overrides: tuple[str, ...]) -> Config:
    """Composition takes a tenth of a second; seeds share it."""
    if overrides not in _composed:
        _composed[overrides] = training_config(overrides)
    return _composed[overrides]
