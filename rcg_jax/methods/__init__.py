"""Start-state methods, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rcg_jax.config.class_path import forms, is_own
from rcg_jax.config.load_class import describe, load_class
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.methods.base import Method
from rcg_jax.methods.check import check_method, line_in_text
from rcg_jax.methods.oracle import Oracle
from rcg_jax.methods.reverse import Reverse
from rcg_jax.methods.self_play import SelfPlay
from rcg_jax.methods.uniform import Uniform
from rcg_jax.tasks.base import Task

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
        raise ConfigError(f"method={name}: {cls.__name__} has no {', '.join(missing)} (docs/own_method.md)")
    try:
        method: Method = cls(task, config)
        check_method(method, task, config)
    except ConfigError as error:
        raise ConfigError(f"method={name}: {error}") from error
    except Exception as error:
        raise ConfigError(f"method={name}: {describe(error)}{line_in_text(error, cls)}") from error
    return method
