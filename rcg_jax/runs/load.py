"""Reading back what was trained: a run with its settings, task and train state; a policy's file with its task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax

from rcg_jax.config.class_path import class_name, is_made, is_own, resolve_name
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.console import one_line
from rcg_jax.io.manifest import DamagedError
from rcg_jax.io.tables import read_columns
from rcg_jax.policies.policy_file import find_policy, load_policy, read_card
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.runs.checkpoint import CheckpointError, Damage, iterations, load, restore
from rcg_jax.runs.settings import read_config
from rcg_jax.tasks import TASKS, make_task
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check import check_task
from rcg_jax.train_step import TrainState, init_train_state


@dataclass(frozen=True)
class Trained:
    """A trained policy with its task: what can be evaluated and rendered.

    Attributes:
        path: a seed's folder, or a policy's file.
        task: its task, on the engine asked for.
        pi: the policy as a function.
        actor: its parameters.
        task_name, method: what it was trained on and with; of own classes, the ClassName.
        seed: of the training.
        iteration: curriculum iterations done.
        env_steps: steps of policy rollouts that it was trained with.
    """

    path: Path
    task: Task
    pi: GaussianPolicy
    actor: Actor
    task_name: str
    method: str
    seed: int
    iteration: int
    env_steps: int


@dataclass(frozen=True)
class LoadedRun(Trained):
    """A run as it was saved: its settings and train state; ``damaged``: newer checkpoints that could not be used."""

    config: Config
    state: TrainState
    damaged: tuple[Damage, ...]


def load_run(path: Path, *, engine: str | None = None, iteration: int | None = None) -> LoadedRun:
    """Loads the run in a seed's folder ``<run_dir>/<task>/<method>/seed<k>``. Changes nothing there.

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
    if is_own(config.task) or is_made(config.task):
        try:
            resolve_name("task", config.task)
        except ConfigError as error:
            raise ConfigError(f"{error}; if it was moved, correct its path in {path / 'config.yaml'}") from None
    task = _make_task(config.task, engine or config.engine)
    state, iteration, damaged = _load_state(path, iteration, jax.eval_shape(lambda: init_train_state(config, task, 0)))
    return LoadedRun(
        path=path,
        task=task,
        pi=make_policy(config, task.action_dim, config.policy.action_repeat),
        actor=state.agent.actor,
        task_name=class_name(config.task),
        method=class_name(config.method),
        seed=config.seed,
        iteration=iteration,
        env_steps=_env_steps(path, config, iteration),
        config=config,
        state=state,
        damaged=damaged,
    )


def _load_state(path: Path, iteration: int | None, like: TrainState) -> tuple[TrainState, int, tuple[Damage, ...]]:
    """The state after ``iteration``, or the newest intact one; its iteration; newer checkpoints that are damaged."""
    folder = path / "checkpoints"
    found = iterations(folder)
    if not found:
        raise ConfigError(f"run={path}: it has no checkpoint yet")
    if iteration is not None and iteration not in found:
        raise ConfigError(f"iteration={iteration}: {path} has checkpoints of {', '.join(map(str, found))}")
    try:
        if iteration is not None:
            return load(folder / str(iteration), like), iteration, ()
        restored = restore([folder], like)
    except DamagedError as error:
        raise ConfigError(f"iteration={iteration}: the checkpoint is damaged: {one_line(error)}") from None
    except CheckpointError as error:
        raise ConfigError(f"run={path}: {one_line(error)}") from None
    assert restored is not None  # the folder has checkpoints
    return restored.states[0], restored.iteration, tuple(restored.damaged)


def _env_steps(path: Path, config: Config, iteration: int) -> int:
    """Steps of policy rollouts until ``iteration``."""
    columns = read_columns(path / "metrics.csv")
    steps = dict(zip(columns.get("iteration", []), columns.get("env_steps", [])))
    where_the_row_is_lost = iteration * config.trpo.iterations * config.rollout.batch_size
    return int(steps.get(iteration, where_the_row_is_lost))


def load_policy_with_task(name: str | Path, *, engine: str | None = None, task: str | None = None) -> Trained:
    """Loads a policy's file and builds its task.

    Args:
        name: see :func:`rcg_jax.policies.policy_file.load_policy`.
        engine: physics engine of the task; None: that of the training.
        task: what ``task=`` says; None: the registered task that the card names.

    Raises:
        ConfigError: one line that says what is missing or does not fit.
    """
    path = find_policy(name)
    card = read_card(path)
    if not task and card.task not in TASKS:
        raise ConfigError(
            f"policy={name}: its task {card.task} is none of {', '.join(TASKS)}; add task=path/to/file.py:{card.task}"
        )
    built = _make_task(task or card.task, engine or card.engine)
    sizes = (("observations", card.obs_dim, built.obs_dim), ("actions", card.action_dim, built.model.nu))
    for what, needs, has in sizes:
        if needs != has:
            raise ConfigError(f"policy={name}: it is for {what} of length {needs}, task={built.name} has {has}")
    return Trained(
        path=path,
        task=built,
        pi=GaussianPolicy(
            card.action_dim, hidden=card.hidden, learn_std=True, output_gain=1.0, action_repeat=card.action_repeat
        ),
        actor=load_policy(name).actor,  # on the device that the engine has chosen
        task_name=card.task,
        method=card.method,
        seed=card.seed,
        iteration=card.iteration,
        env_steps=card.env_steps,
    )


def _make_task(name: str, engine: str) -> Task:
    if engine == "native":
        # It computes on the host; has no effect if this process already uses another device.
        jax.config.update("jax_platforms", "cpu")
    try:
        task = make_task(name, engine)
        check_task(task)
    except (ValueError, RuntimeError, NotImplementedError) as error:
        raise ConfigError(one_line(error)) from None
    return task
