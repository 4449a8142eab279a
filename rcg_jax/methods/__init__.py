"""Start-state methods, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rcg_jax.config import CurriculumConfig
from rcg_jax.methods.method import Method
from rcg_jax.methods.reverse import Reverse
from rcg_jax.methods.uniform import Uniform
from rcg_jax.tasks.task import Task

#: Constructors (task, curriculum settings) -> method.
METHODS: dict[str, Callable[[Task, CurriculumConfig], Method]] = {
    "reverse": Reverse,
    "all_starts": partial(Reverse, all_starts=True),
    "uniform": Uniform,
}


def make_method(name: str, task: Task, config: CurriculumConfig) -> Method:
    """The method called ``name``.

    Raises:
        ValueError: no such method; lists the known ones.
    """
    if name not in METHODS:
        raise ValueError(f"method={name}: must be one of {', '.join(METHODS)}")
    return METHODS[name](task, config)
