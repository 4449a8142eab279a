"""Reverse Curriculum Generation for reinforcement learning (Florensa et al., CoRL 2017) in JAX and MuJoCo."""

from __future__ import annotations

import importlib
import os
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rcg_jax.config.settings import Config as Config
    from rcg_jax.curriculum.sample_nearby import sample_nearby as sample_nearby
    from rcg_jax.interactive import open_policy as open_policy
    from rcg_jax.interactive import open_run as open_run
    from rcg_jax.interactive import train as train
    from rcg_jax.methods.reverse_curriculum import ReverseCurriculum as ReverseCurriculum
    from rcg_jax.policies.policy_file import Policy as Policy
    from rcg_jax.policies.policy_file import load_policy as load_policy
    from rcg_jax.report.scene import RenderError as RenderError
    from rcg_jax.tasks import Task as Task
    from rcg_jax.tasks import make_task as make_task
    from rcg_jax.tasks import register_task as register_task
    from rcg_jax.tasks.from_gymnasium import task_from_gymnasium as task_from_gymnasium
    from rcg_jax.tasks.from_mujoco import task_from_mujoco as task_from_mujoco
    from rcg_jax.tasks.from_playground import task_from_playground as task_from_playground
    from rcg_jax.tasks.randomize import randomized as randomized
    from rcg_jax.tasks.training import training_config as training_config
    from rcg_jax.train_step import init_train_state as init_train_state
    from rcg_jax.train_step import make_train_step as make_train_step
    from rcg_jax.types import StartSet as StartSet

__version__ = "0.1.0"

#: When this process began, nearly, on the clock of ``time.monotonic``: what a command takes is counted from here.
STARTED = time.monotonic()

# XLA logs, at length, that programs from the compilation cache were made for a processor like this one; it reads the
# variable when JAX is first imported. What fails is raised as an exception anyway.
if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":  # JAX sets 1 where it was imported before
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

_EXPORTS = {
    "Config": "rcg_jax.config.settings",
    "Policy": "rcg_jax.policies.policy_file",
    "RenderError": "rcg_jax.report.scene",
    "ReverseCurriculum": "rcg_jax.methods.reverse_curriculum",
    "StartSet": "rcg_jax.types",
    "Task": "rcg_jax.tasks",
    "init_train_state": "rcg_jax.train_step",
    "load_policy": "rcg_jax.policies.policy_file",
    "make_task": "rcg_jax.tasks",
    "make_train_step": "rcg_jax.train_step",
    "open_policy": "rcg_jax.interactive",
    "open_run": "rcg_jax.interactive",
    "randomized": "rcg_jax.tasks.randomize",
    "register_task": "rcg_jax.tasks",
    "sample_nearby": "rcg_jax.curriculum.sample_nearby",
    "task_from_gymnasium": "rcg_jax.tasks.from_gymnasium",
    "task_from_mujoco": "rcg_jax.tasks.from_mujoco",
    "task_from_playground": "rcg_jax.tasks.from_playground",
    "train": "rcg_jax.interactive",
    "training_config": "rcg_jax.tasks.training",
}
__all__ = ["__version__", *_EXPORTS]


def __getattr__(name: str) -> Any:
    # Imported on first use: the command line checks its arguments in a fraction of a second, without JAX.
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
