"""For notebooks and scripts: a training in one call, and what a run or a policy has to show.

    run = rcg_jax.train("task=point_maze", "iterations=40")
    run.evaluations["success_stochastic"]
    run.video()                                            # a notebook shows it
    rcg_jax.open_policy("ring_peg").evaluate(episodes=500)

Files are read when they are asked for, so that a run that goes on can be opened, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

import rcg_jax
from rcg_jax.cli.execute import execute
from rcg_jax.config.compose import compose_config, given_names
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.policies.policy_file import find_policy
from rcg_jax.report.data import read_run
from rcg_jax.report.video import Recording, make_videos, record_episodes
from rcg_jax.runs.evaluation import RunEvaluation, evaluate_run, table
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.load import Trained, load_policy_with_task, load_run
from rcg_jax.runs.settings import read_config
from rcg_jax.runs.start_record import StartRecord, read_starts
from rcg_jax.runs.train import RunError
from rcg_jax.tasks.base import Task


class Videos(str):
    """Videos with their captions, as HTML: a notebook shows them."""

    def _repr_html_(self) -> str:
        return str(self)

    def __repr__(self) -> str:
        return f"<{self.count('<video')} videos>"


class SuccessTable(str):
    """Success with its 95 % interval and by region of the start, as text.

    Attributes:
        result: the same in numbers.
    """

    result: RunEvaluation

    def __repr__(self) -> str:
        return str(self)


class TrainedPolicy:
    """A trained policy with its task.

    Attributes:
        path: the run's folder, or the policy's file.
    """

    def __init__(self, path: Path, load: Callable[[], Trained]) -> None:
        """Made by :func:`open_policy`, :func:`open_run` and :func:`train`."""
        self.path, self._load = path, load

    @cached_property
    def trained(self) -> Trained:
        """Policy, parameters and task, of a run at its newest intact checkpoint; on C MuJoCo, ``engine=native``.

        Raises:
            ConfigError: one line that says what is missing or does not fit.
        """
        enable_compilation_cache()
        return self._load()

    @property
    def task(self) -> Task:
        """Its task."""
        return self.trained.task

    def evaluate(self, episodes: int = 1000, *, seed: int = 0) -> SuccessTable:
        """Success on rho_0, of so many episodes each of the stochastic policy and of its mean action.

        Raises:
            FileNotFoundError: the task has no feasible starts.
            StartsFileError: their file is damaged.
            ValueError: ``episodes`` < 1.
        """
        if episodes < 1:
            raise ValueError(f"episodes={episodes}: must be at least 1")
        result = evaluate_run(self.trained, episodes=episodes, seed=seed)
        text = SuccessTable(table(result))
        text.result = result
        return text

    def episodes(self, number: int = 20, *, seed: int = 0) -> list[Recording]:
        """Episodes of the stochastic policy from rho_0: positions (length + 1, nq), distances [m], success.

        Raises:
            FileNotFoundError: the task has no feasible starts.
            StartsFileError: their file is damaged.
            ValueError: ``number`` < 1.
        """
        if number < 1:
            raise ValueError(f"number={number}: must be at least 1")
        return record_episodes(self.trained, episodes=number, seed=seed, deterministic=False)

    def video(self, number: int = 3) -> Videos:
        """A video of at most ``number`` successes from rho_0, and one of as many failures, if there are any.

        Raises:
            RenderError: this machine cannot draw; the message says what is missing.
            FileNotFoundError: the task has no feasible starts.
            StartsFileError: their file is damaged.
        """
        videos = make_videos(self.trained, number)
        parts = [
            f'<figure style="display: inline-block; margin: 0 1em 0 0"><video controls loop muted src="{one["source"]}"'
            f"></video><figcaption>{one['title']}: {one['caption']}</figcaption></figure>"
            for one in videos
        ]
        return Videos("\n".join(parts))


class Run(TrainedPolicy):
    """A run, in its seed's folder ``<run_dir>/<task>/<method>/seed<k>``."""

    def __init__(self, path: Path) -> None:
        """Made by :func:`open_run` and :func:`train`."""
        super().__init__(path, lambda: load_run(path, engine="native"))

    @property
    def config(self) -> Config:
        """Its settings."""
        return read_config(self.path)

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """Columns of metrics.csv, (iterations,) each; docs/index.md says what they mean.

        Raises:
            ConfigError: no finished iteration yet.
        """
        return read_run(self.path).metrics

    @property
    def evaluations(self) -> dict[str, np.ndarray]:
        """Columns of eval.csv, such as iteration, env_steps and success_stochastic; empty before the first one.

        Raises:
            ConfigError: no finished iteration yet.
        """
        return read_run(self.path).evaluations

    @property
    def starts(self) -> list[StartRecord]:
        """rho_i of every iteration: positions (n, nq), successes (n,) and episodes (n,) of at most 300 starts."""
        return list(read_starts(self.path / "starts.csv"))


def train(*settings: str) -> Run:
    """Trains, or continues, a run in this process; shows its progress.

    Args:
        *settings: ``"name=value"``, as on the command line of ``rcg run``.

    Returns:
        The finished run.

    Raises:
        ConfigError: a setting that is unknown or not allowed, several seeds, or a folder with other settings.
        RunError: it cannot start or go on.
        KeyboardInterrupt: asked to stop; what was done is saved, the same call goes on.
    """
    config = compose_config(settings)
    if config.num_seeds != 1:
        raise ConfigError(
            f"num_seeds={config.num_seeds}: train gives one run; rcg run trains several, open_run opens each"
        )
    rcg_jax.STARTED = time.monotonic()  # what the run takes is counted from here, not from the import
    code, message = execute(config, f"train({', '.join(map(repr, settings))})", given_names(settings))
    if code:
        raise (ConfigError if code == 2 else RunError)(message)
    return Run(RunFolder(config, config.seed).path)


def open_run(path: str | Path) -> Run:
    """The run in a seed's folder ``<run_dir>/<task>/<method>/seed<k>``, finished or not.

    Raises:
        ConfigError: no run there.
    """
    run = Run(Path(path))
    _ = run.config  # refused at once
    return run


def open_policy(name: str | Path, *, task: str | None = None) -> TrainedPolicy:
    """A trained policy with its task, on C MuJoCo.

    Args:
        name: of one that comes with the package, a file ``*.npz``, or the folder of a run with its ``policy.npz``.
        task: as of ``task=`` on the command line; needed for a task of one's own.

    Raises:
        PolicyFileError: no such policy.
    """
    path = find_policy(name)
    return TrainedPolicy(path, lambda: load_policy_with_task(path, engine="native", task=task))
