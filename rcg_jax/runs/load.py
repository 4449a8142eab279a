"""Reading back what was trained: a run with its settings, task and train state; a policy's file with its task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from rcg_jax.config.class_path import class_name, is_own, resolve_name
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.manifest import DamagedError
from rcg_jax.io.tables import read_columns
from rcg_jax.policies.policy_file import Policy, find_policy, load_policy, read_card
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.runs.checkpoint import CheckpointError, Damage, iterations, load, restore
from rcg_jax.runs.settings import read_config
from rcg_jax.tasks import TASKS, make_task
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check import check_task
from rcg_jax.train_step import TrainState, init_train_state


@dataclass(frozen=True)
class LoadedRun:
    """A run as it was saved.

    Attributes:
        path: the seed's folder.
        config: its settings, as they were trained with.
        task: its task, on the engine asked for.
        state: the train state.
        iteration: curriculum iterations done in that state.
        damaged: newer checkpoints that could not be used.
    """

    path: Path
    config: Config
    task: Task
    state: TrainState
    iteration: int
    damaged: tuple[Damage, ...] = ()

    @property
    def env_steps(self) -> int:
        """Steps of policy rollouts that the state was trained with."""
        columns = read_columns(self.path / "metrics.csv")
        steps = dict(zip(columns.get("iteration", []), columns.get("env_steps", [])))
        of_one = self.config.trpo.iterations * self.config.rollout.batch_size  # where the row is lost
        return int(steps.get(self.iteration, self.iteration * of_one))

    @property
    def task_name(self) -> str:
        """Name of the task, or of an own one's class."""
        return class_name(self.config.task)

    @property
    def method(self) -> str:
        """Name of the method, or of an own one's class."""
        return class_name(self.config.method)

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return self.config.seed

    @property
    def pi(self) -> GaussianPolicy:
        """The policy as a function."""
        return make_policy(self.config, self.task.action_dim, self.config.policy.action_repeat)

    @property
    def actor(self) -> Actor:
        """Its parameters."""
        return self.state.agent.actor


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy's file, with its task.

    Attributes:
        path: the file.
        policy: what it holds.
        task: its task, on the engine asked for.
    """

    path: Path
    policy: Policy
    task: Task

    @property
    def iteration(self) -> int:
        """Curriculum iterations that it was trained for."""
        return self.policy.card.iteration

    @property
    def env_steps(self) -> int:
        """Steps of policy rollouts that it was trained with."""
        return self.policy.card.env_steps

    @property
    def task_name(self) -> str:
        """Name of the task that it was trained on, or of an own one's class."""
        return self.policy.card.task

    @property
    def method(self) -> str:
        """Name of the method that it was trained with."""
        return self.policy.card.method

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return self.policy.card.seed

    @property
    def pi(self) -> GaussianPolicy:
        """The policy as a function."""
        card = self.policy.card
        return GaussianPolicy(
            card.action_dim,
            hidden=card.hidden,
            learn_std=True,
            output_gain=1.0,
            action_repeat=card.action_repeat,
        )

    @property
    def actor(self) -> Actor:
        """Its parameters."""
        return self.policy.actor


#: What can be evaluated and rendered.
Trained = LoadedRun | LoadedPolicy


def load_run(path: Path, *, engine: str | None = None, iteration: int | None = None) -> LoadedRun:
    """Loads a run from a seed's folder ``<run_dir>/<task>/<method>/seed<k>``. Changes nothing there.

    Args:
        path: the folder.
        engine: physics engine of the task; None: that of the training.
        iteration: which checkpoint; None: the newest intact one.

    Raises:
        ConfigError: one line that says what is missing or does not fit.
    """
    if not path.is_dir():
        raise ConfigError(f"run={path}: no such folder")
    config = read_config(path)
    if is_own(config.task):
        try:
            resolve_name("task", config.task)
        except ConfigError as error:
            raise ConfigError(f"{error}; if it was moved, correct its path in {path / 'config.yaml'}") from None
    task = _make_task(config.task, engine or config.engine)
    like = jax.eval_shape(lambda: init_train_state(config, task, config.seed))
    folder = path / "checkpoints"
    found = iterations(folder)
    if not found:
        raise ConfigError(f"run={path}: it has no checkpoint yet")
    try:
        if iteration is None:
            return _newest(path, config, task, like)
        if iteration not in found:
            raise ConfigError(f"iteration={iteration}: {path} has checkpoints of {', '.join(map(str, found))}")
        return LoadedRun(path, config, task, load(folder / str(iteration), like), iteration)
    except DamagedError as error:
        raise ConfigError(f"iteration={iteration}: the checkpoint is damaged: {_line(error)}") from None
    except CheckpointError as error:
        raise ConfigError(f"run={path}: {_line(error)}") from None


def load_policy_with_task(name: str | Path, *, engine: str | None = None, task: str | None = None) -> LoadedPolicy:
    """Loads a policy's file and builds its task.

    Args:
        name: see :func:`rcg_jax.policies.policy_file.load_policy`.
        engine: physics engine of the task; None: that of the training.
        task: what ``task=`` says; None: the registered task that the card names.

    Raises:
        ConfigError: one line that says what is missing or does not fit.
    """
    card = read_card(find_policy(name))
    if not task and card.task not in TASKS:
        raise ConfigError(
            f"policy={name}: its task {card.task} is none of {', '.join(TASKS)}; add task=path/to/file.py:{card.task}"
        )
    built = _make_task(task or card.task, engine or card.engine)
    for what, needs, has in (
        ("observations", card.obs_dim, built.obs_dim),
        ("actions", card.action_dim, built.model.nu),
    ):
        if needs != has:
            raise ConfigError(f"policy={name}: it is for {what} of length {needs}, task={built.name} has {has}")
    return LoadedPolicy(find_policy(name), load_policy(name), built)


def _make_task(name: str, engine: str) -> Task:
    if engine == "native":
        # It computes on the host; has no effect if this process already uses another device.
        jax.config.update("jax_platforms", "cpu")
    try:
        task = make_task(name, engine)
        check_task(task)
    except (ValueError, RuntimeError, NotImplementedError) as error:
        raise ConfigError(_line(error)) from None
    return task


def _newest(path: Path, config: Config, task: Task, like: Any) -> LoadedRun:
    restored = restore([path / "checkpoints"], like)
    assert restored is not None  # the folder has checkpoints
    return LoadedRun(path, config, task, restored.states[0], restored.iteration, tuple(restored.damaged))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
