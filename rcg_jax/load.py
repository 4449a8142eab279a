"""Reading a run back: its settings, its task, and the train state of a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from rcg_jax.checkpoint import CheckpointError, Damage, iterations, load, restore
from rcg_jax.config import Config, ConfigError
from rcg_jax.manifest import DamagedError
from rcg_jax.own_name import is_own, resolve_name
from rcg_jax.rl.sizes import batch_size
from rcg_jax.run_folder import read_config
from rcg_jax.tasks import make_task
from rcg_jax.tasks.contract import check_task
from rcg_jax.tasks.task import Task
from rcg_jax.train import TrainState, init_train_state


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
        return self.iteration * self.config.trpo.iterations * batch_size(self.config, self.task)


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
    engine = engine or config.engine
    if engine == "native":
        # It computes on the host; has no effect if this process already uses another device.
        jax.config.update("jax_platforms", "cpu")
    try:
        task = make_task(config.task, engine)
        check_task(task)
    except (ValueError, RuntimeError, NotImplementedError) as error:
        raise ConfigError(_line(error)) from None
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


def _newest(path: Path, config: Config, task: Task, like: Any) -> LoadedRun:
    restored = restore([path / "checkpoints"], like)
    assert restored is not None  # the folder has checkpoints
    return LoadedRun(path, config, task, restored.states[0], restored.iteration, tuple(restored.damaged))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
