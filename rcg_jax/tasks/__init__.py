"""The paper's tasks, by name."""

from __future__ import annotations

from rcg_jax.tasks.key_insertion import KeyInsertion
from rcg_jax.tasks.ring_peg import RingPeg
from rcg_jax.tasks.task import Task as Task

#: Registered task classes.
TASKS: dict[str, type[Task]] = {task.name: task for task in (RingPeg, KeyInsertion)}


def register_task(task: type[Task]) -> type[Task]:
    """Makes a task class known to :func:`make_task` under its ``name``; usable as a class decorator.

    The command line knows only the tasks that come with the package.

    Raises:
        ValueError: the name is taken by another class.
    """
    if TASKS.setdefault(task.name, task) is not task:
        raise ValueError(f"task={task.name}: already registered by {TASKS[task.name].__qualname__}")
    return task


def make_task(name: str, engine: str = "mjx") -> Task:
    """The task called ``name``, on the physics engine ``engine`` (mjx or native).

    Raises:
        ValueError: no such task or engine; lists the known ones.
    """
    if name not in TASKS:
        raise ValueError(f"task={name}: must be one of {', '.join(TASKS)}")
    return TASKS[name](engine)
