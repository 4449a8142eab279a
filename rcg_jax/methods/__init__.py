"""Start-state methods, by name, and what a custom one has to keep to."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax

from rcg_jax.config.class_path import forms, is_own
from rcg_jax.config.load_class import describe, line_in, load_class
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.methods.base import Method, MethodMetrics
from rcg_jax.methods.oracle import Oracle
from rcg_jax.methods.reverse import Reverse
from rcg_jax.methods.self_play import SelfPlay
from rcg_jax.methods.uniform import Uniform
from rcg_jax.rl.agent import init_agent
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet

#: Constructors (task, settings) -> method.
METHODS: dict[str, Callable[[Task, Config], Method]] = {
    "reverse": Reverse,
    "all_starts": partial(Reverse, all_starts=True),
    "uniform": Uniform,
    "oracle": Oracle,
    "self_play": SelfPlay,
}


def make_method(name: str, task: Task, config: Config) -> Method:
    """The method called ``name``: a registered one, ``path/to/file.py:ClassName`` or ``package.module:ClassName``.

    Raises:
        ValueError: no such method, listing the known ones.
        ConfigError: a class of one's own that cannot be used, or a method that this task does not support.
    """
    if name in METHODS:
        return METHODS[name](task, config)
    if not is_own(name):
        raise ValueError(f"method={name}: must be {forms('method')}")
    cls = load_class("method", name)
    missing = [part for part in ("init", "propose", "update") if not callable(getattr(cls, part, None))]
    if missing:
        raise ConfigError(f"method={name}: {cls.__name__} has no {', '.join(missing)} (docs/custom_methods.md)")
    try:
        method: Method = cls(task, config)
        check_method(method, task, config)
    except ConfigError as error:
        raise ConfigError(f"method={name}: {error}") from error
    except Exception as error:
        raise ConfigError(f"method={name}: {describe(error)}{_line_in(error, cls)}") from error
    return method


def check_method(method: Method, task: Task, config: Config) -> None:
    """Traces init, propose and update once and looks at what they return. Compiles nothing.

    Raises:
        ConfigError: one line: which function returns what it should not.
        Exception: whatever the method's own code raises while it is traced.
    """
    key = jax.random.key(0)
    agent = jax.eval_shape(lambda: init_agent(config, key, task.obs_dim, task.action_dim))
    state = jax.eval_shape(method.init, key)
    proposed = jax.eval_shape(method.propose, key, state, agent)
    if not isinstance(proposed, tuple) or len(proposed) != 2 or not isinstance(proposed[1], StartSet):
        raise ConfigError(f"propose must return (state, StartSet), not {_kind(proposed)}")
    proposing, starts = proposed
    _same("propose", state, proposing)
    wanted = {"qpos": (task.model.nq,), "qvel": (task.model.nv,), "valid": ()}
    if task.model.na:
        wanted["act"] = (task.model.na,)
    for name, shape in wanted.items():
        found = getattr(getattr(starts, name), "shape", None)
        if found != (starts.capacity, *shape):
            raise ConfigError(f"propose returns starts with {name} of shape {found}, not {(starts.capacity, *shape)}")
    labels = jax.eval_shape(lambda: StartLabels.none(starts.capacity))
    updated = jax.eval_shape(method.update, key, proposing, starts, labels)
    if not isinstance(updated, tuple) or len(updated) != 2 or not isinstance(updated[1], MethodMetrics):
        raise ConfigError(f"update must return (state, MethodMetrics), not {_kind(updated)}")
    _same("update", state, updated[0])
    if any(leaf.shape for leaf in jax.tree.leaves(updated[1])):
        raise ConfigError("update must return metrics that are scalars")


def _same(function: str, before: Any, after: Any) -> None:
    """The state keeps its structure, shapes and types: one compiled train step serves all iterations."""
    if str(jax.tree.structure(before)) != str(jax.tree.structure(after)):
        raise ConfigError(f"{function} must return a state of the structure that init gives")
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            raise ConfigError(f"{function} changes a part of the state from {a.dtype}{a.shape} to {b.dtype}{b.shape}")


def _kind(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_kind, value))})"
    if isinstance(value, jax.ShapeDtypeStruct):
        return f"{value.dtype}{value.shape}"
    return "None" if value is None else type(value).__name__


def _line_in(error: BaseException, cls: type) -> str:
    """`` (own.py, line 7)``: where in the class's file an exception came from."""
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    number = line_in(error, Path(file)) if file else None
    return f" ({Path(file).name}, line {number})" if file and number else ""
