"""Whether a policy's success is the task's or the simulator's: the same episodes in other physics.

    python -m experiments.cross_check                          # all shipped policies
    python -m experiments.cross_check policy=ring_peg,key_insertion episodes=200
    python -m experiments.cross_check run=runs/ring_peg/reverse/seed0

A policy plays the same starts with the same action noise in

- ``as trained``: the engine and the solver's settings that it was trained with,
- ``tight``: C MuJoCo with a solver that goes on until nothing changes (200 Newton iterations, 100 of the line search,
  tolerance 1e-10),
- ``fine``: the same with a quarter of the time step and every action held for four of them. These are other physics, as
  contacts act earlier and damping is integrated differently: how far a result depends on the time step,
- ``mjx`` (``native`` for a policy that was trained with mjx): the other engine.

``cross_check.csv`` has the success in each, whether its 95 % Wilson interval overlaps with that of ``as trained``, the
share of the episodes whose outcome is another one (contacts make trajectories chaotic, so that some may differ although
the physics are the same), which way they differ, and the probability of that or a larger imbalance if both are equally
good (sign test); and, of the episodes that reach the goal in both, the share that take another number of steps. Rows of
other policies stay.
"""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import mujoco
import numpy as np
from jax import Array
from scipy import stats

from experiments.report import in_one_line, machine, options
from experiments.trained import ACTIONS, Subject, fewer, folder, merge, play, rate, subjects
from rcg_jax.config.settings import option
from rcg_jax.physics import make_engine
from rcg_jax.physics.engine import Engine
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.rl.episodes import Episodes
from rcg_jax.runs.load import Trained
from rcg_jax.tasks import Task
from rcg_jax.types import PhysicsState

#: Solver settings under which C MuJoCo's Newton solver ends because nothing changes any more.
TIGHT = {"iterations": 200, "ls_iterations": 100, "tolerance": 1e-10, "ls_tolerance": 1e-4}


@dataclass(frozen=True)
class CheckOptions:
    """Settings of ``python -m experiments.cross_check``."""

    policy: str = option("all", "shipped policies or files *.npz, separated by commas; all: every shipped one")
    run: str = option("none", "instead of policy: folder of a seed")
    episodes: int = option(500, "episodes of each policy; proportionally fewer where T is more than 500 steps", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    results: str = option("default", "folder of the CSV file; default: experiments/results, or the run's own")


class Held:
    """An engine whose step is several steps of another one under the same controls."""

    def __init__(self, inner: Engine, steps: int) -> None:
        self.name, self.model, self.fusion_emitters = inner.name, inner.model, inner.fusion_emitters
        self._inner, self._steps = inner, steps

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`; ``bad`` if any of the steps was."""

        def one(_: Any, now: PhysicsState) -> PhysicsState:
            after = self._inner.step(now, ctrl)
            return after.replace(bad=after.bad | now.bad)  # type: ignore[attr-defined]

        return jax.lax.fori_loop(0, self._steps, one, state)


@dataclass(frozen=True)
class Physics:
    """How a task is simulated.

    Attributes:
        name: in the table.
        engine: mjx or native.
        solver: fields of ``mujoco.MjOption`` that differ from the task's.
        substeps: steps per action, each that much shorter.
    """

    name: str
    engine: str
    solver: Mapping[str, float] = field(default_factory=dict)
    substeps: int = 1

    def apply(self, task: Task) -> Task:
        """A task that differs from ``task``, which is on :attr:`engine`, in its physics alone."""
        if not self.solver and self.substeps == 1:
            return task
        model = copy.deepcopy(task.model)
        for name, value in self.solver.items():
            setattr(model.opt, name, value)
        model.opt.timestep = task.model.opt.timestep / self.substeps
        changed = copy.copy(task)  # what else it holds does not depend on these options
        changed.model = model
        engine = make_engine(self.engine, model)
        changed.engine = Held(engine, self.substeps) if self.substeps > 1 else engine
        return changed


def variants(trained_on: str) -> list[Physics]:
    """What a policy is tried in; first the physics that it was trained with."""
    other = "mjx" if trained_on == "native" else "native"
    return [
        Physics("as trained", trained_on),
        Physics("tight", "native", TIGHT),
        Physics("fine", "native", TIGHT, substeps=4),
        Physics(other, other),
    ]


def compare(first: Episodes, other: Episodes) -> dict[str, Any]:
    """Cells of E episodes in other physics, beside the same episodes in the first."""
    reference, here = np.asarray(first.success), np.asarray(other.success)
    both = reference & here
    moved = int(np.sum((np.asarray(first.length) != np.asarray(other.length)) & both))
    mine, its = rate(int(here.sum()), len(here)), rate(int(reference.sum()), len(reference))
    lost, won = int((reference & ~here).sum()), int((~reference & here).sum())
    p = float(stats.binomtest(lost, lost + won).pvalue) if lost + won else 1.0
    return {
        **mine,
        "intervals_overlap": "yes" if mine["low"] <= its["high"] and its["low"] <= mine["high"] else "no",
        "outcome_differs": round((lost + won) / len(here), 4),
        "only_as_trained": lost,
        "only_here": won,
        "sign_test_p": float(f"{p:.3g}"),
        "steps_differ": round(moved / both.sum(), 4) if both.any() else "",
    }


def check(subject: Subject, chosen: CheckOptions) -> list[dict[str, Any]]:
    """Rows of a policy.

    Raises:
        ConfigError: it cannot be loaded, or its task has no feasible starts.
    """
    first = subject.load()
    episodes = fewer(chosen.episodes, first.task.horizon)
    rows: list[dict[str, Any]] = []
    reference: dict[str, Episodes] = {}
    for physics in variants(first.task.engine.name):
        begin = time.monotonic()
        loaded: Trained = first if physics.engine == first.task.engine.name else subject.load(physics.engine)
        task = physics.apply(loaded.task)
        result = play(first, task, episodes=episodes, seed=chosen.seed)
        seconds = time.monotonic() - begin
        opt: mujoco.MjOption = task.model.opt
        for actions in ACTIONS:
            outcome: Episodes = getattr(result, actions)
            reference.setdefault(actions, outcome)
            rows.append(
                {
                    "policy": subject.name,
                    "task": first.task_name,
                    "physics": physics.name,
                    "engine": physics.engine,
                    "time_step_s": opt.timestep,
                    "iterations": opt.iterations,
                    "ls_iterations": opt.ls_iterations,
                    "tolerance": opt.tolerance,
                    "actions": actions,
                    **compare(reference[actions], outcome),
                    "seed": chosen.seed,
                    "seconds": round(seconds, 1),
                }
            )
        shown = ", ".join(f"{row['actions']} {row['success']:.3f}" for row in rows[-2:])
        print(f"{subject.name}: {physics.name}: {episodes} episodes, {shown} ({seconds:.0f} s)", flush=True)
    return rows


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the CSV file for a page."""
    lines = [
        "| policy | physics | stochastic | mean action | outcome differs | steps differ | intervals overlap |",
        "|" + "---|" * 7,
    ]
    cells: dict[tuple[str, str], dict[str, Mapping[str, str]]] = {}
    for row in rows:
        cells.setdefault((row["policy"], row["physics"]), {})[row["actions"]] = row
    for (policy, physics), both in cells.items():
        pair = [both[name] for name in ACTIONS]
        rates = [f"{float(r['success']):.3f} [{float(r['low']):.3f}, {float(r['high']):.3f}]" for r in pair]
        words = ["", "", ""]
        if physics != "as trained":
            words = [
                ", ".join(f"{100 * float(r['outcome_differs']):.1f} %" for r in pair),
                ", ".join(f"{100 * float(r['steps_differ']):.0f} %" if r["steps_differ"] else "-" for r in pair),
                ", ".join(r["intervals_overlap"] for r in pair),
            ]
        engine = "" if physics == pair[0]["engine"] else f" ({pair[0]['engine']})"
        lines.append(f"| {' | '.join([policy, physics + engine, *rates, *words])} |")
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Checks, writes and prints; returns the exit code."""
    chosen = options(CheckOptions, "experiments.cross_check")
    enable_compilation_cache()
    found = subjects(chosen.policy, chosen.run)
    path = folder(chosen.results, chosen.run) / "cross_check.csv"
    for subject in found:
        about = machine()
        rows = merge(path, [{**row, **about} for row in check(subject, chosen)])
    print(f"\n{markdown(rows)}\n\n{path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
