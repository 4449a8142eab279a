"""The settings of a run that there is, and in which of them another would differ."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcg_jax.config.schema import make_schema
from rcg_jax.config.settings import Config, ConfigError, flatten

#: Settings that a run may continue with changed: they do not touch what training computes, or its rounding alone. A
#: preset's name does not count either, because each value that it sets does.
FREE = frozenset(
    {
        *("preset", "num_seeds", "iterations", "run_dir", "eval_every", "checkpoint_every", "write_report"),
        *("devices", "matmul_precision"),
    }
)

#: Groups of such settings.
_FREE_GROUPS = ("evaluation.", "hosts.")

#: Settings that not every version has, with the value that leaves a run as it is without them.
VERSIONED: dict[str, Any] = {
    "curriculum.stall_walk": 0,
    "trpo.mastered_failures": 0.0,  # counted the failures of a batch; became the next
    "trpo.full_step_failures": 0.0,
    "policy.action_repeat": 0,  # the task's own, which was 1: see LEFT_TO_THE_TASK
    "curriculum.rho_0_share": -1.0,  # the task's own, which was 0
    "rollout.batch": "segments",
    "rollout.value_at_horizon": True,
}

#: What a task's class sets for training, beside the settings, with the value of a class that sets nothing and of runs
#: of before there was such an attribute. A run keeps those that differ, as the group ``Task`` of its config.yaml.
TASK_ATTRIBUTES: dict[str, Any] = {
    "Task.init_std": 1.0,
    "Task.settle_steps": 0,
    "Task.action_repeat": 1,
    "Task.rho_0_share": 0.0,
}

#: Settings that say what they come to wherever runs are compared: their value that leaves it to the task, and which of
#: :data:`TASK_ATTRIBUTES` it is then.
LEFT_TO_THE_TASK: dict[str, tuple[Any, str]] = {
    "policy.action_repeat": (0, "Task.action_repeat"),
    "curriculum.rho_0_share": (-1.0, "Task.rho_0_share"),
}


def is_free(name: str) -> bool:
    """Whether the setting may differ when a run continues."""
    return name in FREE or name.startswith(_FREE_GROUPS)


def _read_yaml(path: Path) -> DictConfig:
    try:
        tree = OmegaConf.load(path)
    except Exception as error:  # OSError, or one of several of the parser's own
        raise ConfigError(f"{path}: cannot be read: {' '.join(str(error).split())[:160]}") from None
    if not isinstance(tree, DictConfig):
        raise ConfigError(f"{path}: cannot be read: it holds no settings")
    return tree


def read_values(path: Path) -> dict[str, Any]:
    """Settings of a ``config.yaml`` by dotted name.

    Raises:
        ConfigError: the file cannot be read.
    """
    values: dict[str, Any] = {}
    tree: Any = OmegaConf.to_container(_read_yaml(path))
    for name, value in tree.items():
        if isinstance(value, dict):
            values.update({f"{name}.{inner}": each for inner, each in value.items()})
        else:
            values[name] = value
    return values


def task_attributes(task: str) -> dict[str, Any]:
    """Those of :data:`TASK_ATTRIBUTES` that the class of a task sets to something else, in this version of it.

    Raises:
        ConfigError: the file of an own class cannot be used.
    """
    from rcg_jax.tasks import task_class  # imports JAX

    cls = task_class(task)
    found = {name: getattr(cls, name.partition(".")[2]) for name in TASK_ATTRIBUTES}
    numbers = {name: value for name, value in found.items() if isinstance(value, Real)}
    # A number of NumPy's is written as a number.
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in numbers.items()
        if value != TASK_ATTRIBUTES[name]
    }


def former_settings(values: dict[str, Any]) -> list[str]:
    """Settings of a run, ``name=value``, that this version does not have any more and that changed the run."""
    present = {name for name, _, _ in flatten(Config())}
    return [
        f"{name}={values[name]}"
        for name, neutral in VERSIONED.items()
        if name not in present and values.get(name, neutral) != neutral
    ]


def resolved(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name, with what those of :data:`LEFT_TO_THE_TASK` come to: as set, or the task's own."""
    result = dict(values)
    for name, (left, attribute) in LEFT_TO_THE_TASK.items():
        own = result.pop(attribute, TASK_ATTRIBUTES[attribute])
        value = result.get(name, left)
        result[name] = own if value == left else value
    return result


def settings_on(task: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name as a run's folder gives them on a task; where its class cannot be found any more, those
    that are left to it are as of a class that sets nothing."""
    try:
        own = task_attributes(task)
    except ConfigError:
        own = {}
    return resolved({**settings, **own})


def differences(old: dict[str, Any], new: Config) -> list[str]:
    """Settings, other than the free ones, in which a run would change: ``name old -> new``."""
    absent = VERSIONED | TASK_ATTRIBUTES
    values = resolved(absent | {name: value for name, _, value in flatten(new)} | task_attributes(new.task))
    old = resolved(absent | old)
    names = [name for name in dict.fromkeys([*values, *old]) if not is_free(name)]
    return [
        f"{name} {old.get(name, '(absent)')} -> {values.get(name, '(absent)')}"
        for name in names
        if name not in old or name not in values or old[name] != values[name]
    ]


def old_words(old: dict[str, Any], changes: list[str]) -> str:
    """``: name=value ...`` of a run's settings that changed, as for the command line; nothing where some are not."""
    present = {name for name, _, _ in flatten(Config())}
    words = []
    for name in (change.partition(" ")[0] for change in changes):
        value = resolved(VERSIONED | TASK_ATTRIBUTES | old).get(name)
        if name not in present or value is None:
            return ""
        words.append(f"{name}={str(value).lower() if isinstance(value, bool) else str(value).replace(' ', '')}")
    return f": {' '.join(words)}"


def read_config(run: Path) -> Config:
    """Settings of an existing run.

    Args:
        run: a seed's folder. Settings of :data:`VERSIONED` that this version does not have any more are left out, and
            those that the run does not have yet are off. Those of :data:`LEFT_TO_THE_TASK` are what it was trained
            with.

    Raises:
        ConfigError: no run there, or its settings do not fit this program.
    """
    path = run / "config.yaml"
    if not path.exists():
        raise ConfigError(f"run={run}: no config.yaml there; a run's folder is <run_dir>/<task>/<method>/seed<k>")
    tree, schema = _read_yaml(path), make_schema()
    attributes = tree.pop("Task", {})  # no settings
    for setting, neutral in VERSIONED.items():
        group, _, name = setting.partition(".")
        if name in schema[group]:
            schema[group][name] = neutral
        elif group in tree:
            tree[group].pop(name, None)
    try:
        config = OmegaConf.to_object(OmegaConf.merge(schema, tree))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{path}: {' '.join(str(error).split())[:160]}") from None
    assert isinstance(config, Config)
    # The run goes on as it was trained, whatever the task's class says today.
    named = {f"Task.{name}": value for name, value in attributes.items()}
    values = resolved({name: value for name, _, value in flatten(config)} | named)
    for setting in LEFT_TO_THE_TASK:
        group, _, name = setting.partition(".")
        part = dataclasses.replace(getattr(config, group), **{name: values[setting]})
        config = dataclasses.replace(config, **{group: part})
    return config
