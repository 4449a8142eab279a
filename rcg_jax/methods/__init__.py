"""Start-state methods, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rcg_jax.config import Config
from rcg_jax.methods.method import Method
from rcg_jax.methods.oracle import Oracle
from rcg_jax.methods.reverse import Reverse
from rcg_jax.methods.self_play import SelfPlay
from rcg_jax.methods.uniform import Uniform
from rcg_jax.tasks.task import Task

#: Constructors (task, settings) -> method.
METHODS: dict[str, Callable[[Task, Config], Method]] = {
    "reverse": Reverse,
    "all_starts": partial(Reverse, all_starts=True),
    "uniform": Uniform,
    "oracle": Oracle,
    "self_play": SelfPlay,
}


def make_method(name: str, task: Task, config: Config) -> Method:
    """The method called ``name``.

    Raises:
        ValueError: no such method; lists the known ones.
    """
    if name not in METHODS:
        raise ValueError(f"method={name}: must be one of {', '.join(METHODS)}")
    return METHODS[name](task, config)
