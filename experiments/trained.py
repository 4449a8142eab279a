"""What the scripts that look at trained policies share: which policies, their episodes from rho_0, their CSV rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.report import RESULTS, locked, read, write_rows
from rcg_jax.config.settings import ConfigError
from rcg_jax.curriculum.feasible import make_compositions
from rcg_jax.evaluation.success import EvalResult, make_actor_evaluate
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.physics.jit import jit
from rcg_jax.policies.policy_file import find_policy, shipped_policies
from rcg_jax.runs.load import Trained, load_policy_with_task, load_run
from rcg_jax.stats import wilson_interval
from rcg_jax.tasks import Task

#: The two ways a policy acts, as in :class:`rcg_jax.evaluation.success.EvalResult`.
ACTIONS = ("stochastic", "mean")


@dataclass(frozen=True)
class Subject:
    """A policy to look at.

    Attributes:
        name: what rows of it are known by.
        run: the folder of its run; None: a policy's file.
    """

    name: str
    run: Path | None = None

    @property
    def file(self) -> str:
        """The name, as part of a file's name."""
        return self.name.replace("/", "_") if self.run else Path(self.name).stem

    def load(self, engine: str | None = None) -> Trained:
        """The policy with its task, on the engine of its training by default.

        Raises:
            ConfigError: one line that says what is missing or does not fit.
        """
        return load_run(self.run, engine=engine) if self.run else load_policy_with_task(self.name, engine=engine)


def subjects(policy: str, run: str) -> list[Subject]:
    """What ``policy=`` and ``run=`` of a command line ask for.

    Args:
        policy: names of shipped policies or paths of files, separated by commas; ``all``: every shipped one.
        run: a seed's folder instead, or ``none``.

    Raises:
        ConfigError: both are given, or there is no such policy.
    """
    if run != "none":
        if policy != "all":
            raise ConfigError(f"policy={policy} run={run}: one of them, not both")
        return [Subject("/".join(Path(run).resolve().parts[-3:]), Path(run))]
    names = shipped_policies() if policy == "all" else policy.split(",")
    for name in names:
        find_policy(name)  # before the first of them is played
    return [Subject(name) for name in names]


def folder(results: str, run: str) -> Path:
    """Where CSV files and pictures go: ``results=`` if it is given, or else a run's into its own folder.

    Raises:
        ConfigError: there is no such run.
    """
    if results != "default":
        return Path(results)
    if run != "none" and not Path(run).is_dir():
        raise ConfigError(f"run={run}: no such folder")
    return RESULTS if run == "none" else Path(run)


def fewer(episodes: int, horizon: int) -> int:
    """Episodes that cost what ``episodes`` of 500 steps cost; never more than these."""
    return min(episodes, max(1, episodes * 500 // horizon))


def play(run: Trained, task: Task, *, episodes: int, seed: int, horizon: int | None = None) -> EvalResult:
    """Episodes of a policy on a task; the same starts and the same noise for the same ``episodes`` and ``seed``.

    Args:
        run: the policy.
        task: its task, on any engine.
        episodes: E, with the stochastic policy and with its mean action.
        seed: of starts and noise.
        horizon: steps that an episode may take; the task's T by default.

    Raises:
        ConfigError: the task has no feasible starts, or their file is damaged.
    """
    try:
        evaluate = jit(
            make_actor_evaluate(run.pi, task, episodes, horizon), fusion_emitters=task.engine.fusion_emitters
        )
    except (FileNotFoundError, StartsFileError) as error:
        raise ConfigError(str(error)) from None
    return jax.device_get(evaluate(run.actor, jax.random.key(seed)))


def starts(task: Task, result: EvalResult) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Where the episodes began: positions (E, nq), the task's named subsets, distances to the goal (E,) [m]."""
    qpos = np.asarray(task.feasible_starts().qpos)[result.start]
    return (qpos, *make_compositions(task)(qpos))


def rate(successes: int, episodes: int) -> dict[str, Any]:
    """Cells of a success rate with its 95 % Wilson interval."""
    low, high = wilson_interval(successes, episodes)
    return {
        "episodes": episodes,
        "successes": successes,
        "success": round(successes / episodes, 4),
        "low": round(low, 4),
        "high": round(high, 4),
    }


def merge(path: Path, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Replaces a CSV file's rows of the same ``policy``; returns all of them, in the order of tasks as written.

    Raises:
        ResultsError: the file is damaged.
    """
    with locked(path.parent):
        new = {row["policy"] for row in rows}
        old = [row for row in read(path) if row.get("policy") not in new] if path.exists() else []
        write_rows(path, sorted([*old, *rows], key=lambda row: str(row["policy"])))
        return read(path)
