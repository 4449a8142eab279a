"""What a task trains with instead of the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rcg_jax.config.presets import TASK_SETTINGS
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.config.validate import requirement
from rcg_jax.tasks import TASKS, task_class
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check_model import refuse

#: Groups of settings that are about learning; the others are about one run.
GROUPS = ("curriculum", "rollout", "trpo", "ppo", "policy", "baseline", "oracle", "self_play")


def task_settings(task: str | type[Task]) -> dict[str, Any]:
    """What ``task=`` trains with instead of the defaults: settings by dotted name, of the types of :class:`Config`.

    They are those of :data:`rcg_jax.config.presets.TASK_SETTINGS`, or of a custom class's attribute ``training``; a
    subclass adds to, or replaces, those of the classes that it extends.

    Args:
        task: as of ``task=``, whose class is imported; or the class.

    Raises:
        ConfigError: no such task, the file of a custom class cannot be used, or ``training`` names what is no setting
            of :data:`GROUPS`, or gives it a value of another type. One line.
    """
    try:
        cls = task_class(task) if isinstance(task, str) else task
    except ValueError as error:
        raise ConfigError(str(error)) from error
    result: dict[str, Any] = {}
    for base in reversed(cls.__mro__):  # mixins that are no tasks count, too
        if base not in Task.__mro__:
            result |= _own_settings(base, cls)
    return result


def _own_settings(base: type, cls: type[Task]) -> dict[str, Any]:
    """What one of the classes that the task class ``cls`` extends asks for."""
    where = base if issubclass(base, Task) else cls
    name = getattr(base, "name", "")
    own = vars(base).get("training", TASK_SETTINGS.get(name, {}) if TASKS.get(name) is base else {})
    if not isinstance(own, Mapping):
        refuse(where, f"training is a {type(own).__name__}: must be a dict of settings of python -m rcg_jax.run")
    fields = {name: item for name, item, _ in flatten(Config()) if name.partition(".")[0] in GROUPS}
    result = {}
    for name, value in own.items():
        if name not in fields:
            refuse(
                where,
                f"training: {name} must be the dotted name of a setting, such as trpo.max_kl, of {', '.join(GROUPS)} "
                f"(--help lists them)",
            )
        try:
            result[name] = _typed(value, str(fields[name].type))
        except TypeError:
            refuse(where, f"training: {name}={value!r}: must be {requirement(fields[name])}")
    return result


def _typed(value: Any, kind: str) -> Any:
    """``value``, also of NumPy, as a setting of type ``kind`` has it; TypeError where it is of another type."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if kind == "list[int]" and isinstance(value, list | tuple):
        return [_typed(each, "int") for each in value]
    allowed = {"bool": bool, "str": str, "int": int, "float": int | float}.get(kind, ())
    if not isinstance(value, allowed) or (isinstance(value, bool) and kind != "bool"):
        raise TypeError
    return float(value) if kind == "float" else value
