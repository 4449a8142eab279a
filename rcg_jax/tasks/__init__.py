"""The paper's tasks, by name, and how own ones are found."""

from __future__ import annotations

from rcg_jax.config import names
from rcg_jax.config.class_path import forms, is_made, is_own, resolve_name
from rcg_jax.config.load_class import load_class
from rcg_jax.config.settings import ConfigError
from rcg_jax.tasks.ant_maze import AntMaze
from rcg_jax.tasks.base import Task as Task
from rcg_jax.tasks.by_name import made_task
from rcg_jax.tasks.check import build_task
from rcg_jax.tasks.key_insertion import KeyInsertion
from rcg_jax.tasks.point_maze import PointMaze
from rcg_jax.tasks.ring_peg import RingPeg

#: Registered task classes.
TASKS: dict[str, type[Task]] = {task.name: task for task in (PointMaze, AntMaze, RingPeg, KeyInsertion)}


def register_task(task: type[Task]) -> type[Task]:
    """Makes a task class known to :func:`make_task` under its ``name``; usable as a class decorator.

    A class that is defined again, as in a notebook whose cell was edited, takes the place of its former self.

    Raises:
        ValueError: the name is taken by another class.
    """
    known = TASKS.get(task.name, task)
    if (known.__module__, known.__qualname__) != (task.__module__, task.__qualname__):
        raise ValueError(f"task={task.name}: already registered by {known.__qualname__}")
    TASKS[task.name] = task
    return task


def task_class(name: str) -> type[Task]:
    """The class called ``name``: a registered name, ``path/to/file.py:ClassName`` or ``package.module:ClassName``.

    Or one made of a model, ``path/to/model.xml:POINT@KEYFRAME``, or of an environment, ``gymnasium:ENV_ID`` or
    ``playground:ENV`` (:func:`rcg_jax.tasks.by_name.made_task`).

    Raises:
        ValueError: no such task, or (:class:`rcg_jax.config.settings.ConfigError`) its file cannot be used.
    """
    if name in TASKS:
        return TASKS[name]
    if is_made(name):
        return made_task(resolve_name("task", name))
    if is_own(name):
        found = load_class("task", name)
        if not issubclass(found, Task) or found is Task:
            raise ConfigError(f"task={name}: {found.__name__} is no subclass of rcg_jax.Task")
        return found
    registered = ", ".join(known for known in TASKS if known not in names.TASKS)
    here = f" registered here {registered}," if registered else ""
    raise ValueError(f"task={name}: must be {forms('task').replace(' or a class', f'{here} or a class')}")


def make_task(name: str, engine: str = "mjx") -> Task:
    """The task called ``name`` (see :func:`task_class`) on a physics engine, one of :data:`rcg_jax.physics.ENGINES`.

    Raises:
        ValueError: no such task or engine, listing the known ones; or (:class:`rcg_jax.config.settings.ConfigError`) a
            class that cannot be built, saying why.
        RuntimeError: the engine does not run on this device.
    """
    return build_task(task_class(name), engine)
