"""What a task must be, checked before anything large is compiled. A breach is one sentence: where, what, the value."""

from __future__ import annotations

import numbers
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcg_jax.config.arguments import parse_arguments
from rcg_jax.config.load_class import describe
from rcg_jax.config.search import FeasibleConfig
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.physics import check_engine
from rcg_jax.physics.engine import UnsupportedModelError, reset
from rcg_jax.physics.jit import jit
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check_model import (
    ContractError,
    check_goal_state,
    check_model,
    check_one_step,
    check_overlap,
    check_range,
    neutral_ctrl,
    one_line,
    place,
    random_states,
    refuse,
    roll_out,
)
from rcg_jax.types import Snapshot, StartSet

#: Feasible starts that stand for all of them in the check, and the share that may lie outside the region: states on
#: its edge fall to either side on another machine.
_SAMPLE, _OUTSIDE = 256, 0.02


def search_words(task: Task | type[Task]) -> list[str]:
    """The settings that a task's ``search`` asks for, as the command line would.

    Starts settle for the task's ``settle_steps``, where it has some and its search does not say otherwise.
    """
    settle = {"settle_steps": task.settle_steps} if task.settle_steps else {}
    return [f"{name}={value}" for name, value in {**settle, **task.search}.items()]


def build_task(cls: type[Task], engine: str) -> Task:
    """An instance of a task class.

    Args:
        cls: the class.
        engine: one of :data:`rcg_jax.tasks.base.ENGINE_NAMES`.

    Raises:
        ContractError: the class is incomplete, its model cannot be loaded, or the engine cannot simulate it.
        ValueError: no such engine; lists the known ones.
        RuntimeError: the engine does not run on this device.
    """
    check_engine(engine)  # before the class's own code runs, which may raise anything
    missing = sorted(cls.__abstractmethods__)
    if not hasattr(cls, "xml") and cls.make_model is Task.make_model:
        missing.insert(0, "xml")
    if missing:
        refuse(cls, f"lacks {', '.join(missing)}; every task has to give {'it' if len(missing) == 1 else 'them'}")
    if cls.make_model is Task.make_model and not cls.xml.is_file():
        refuse(cls, f"xml: no such file: {cls.xml}")
    try:
        with jax.ensure_compile_time_eval():  # it may be built inside a jit
            return cls(engine)
    except UnsupportedModelError as error:
        refuse(cls, f"engine={engine}: {one_line(error)}", error)
    except Exception as error:
        refuse(cls, f"cannot be built{place(cls, error)}: {describe(error)}", error)


def check_task(task: Task, *, starts: bool = True) -> None:
    """Checks a task against the contract of :class:`rcg_jax.tasks.Task`, in a second or two.

    Args:
        task: the task.
        starts: whether its feasible starts have to be there, too.

    Raises:
        ContractError: the first breach.
    """
    cls = type(task)
    if not isinstance(task.horizon, numbers.Integral) or isinstance(task.horizon, bool) or task.horizon < 1:
        refuse(cls, f"horizon = {task.horizon!r}: must be an integer >= 1, physics steps per episode")
    steps = task.settle_steps
    if not isinstance(steps, numbers.Integral) or isinstance(steps, bool) or steps < 0:
        refuse(cls, f"settle_steps = {steps!r}: must be an integer >= 0, steps that a start at rest stays feasible")
    search = check_search(cls)
    check_model(task)
    goal = check_goal_state(task)
    check_range(task, goal, search.max_excess)
    check_overlap(task, goal, search.max_depth)
    check_one_step(task, goal)
    _check_signatures(task)
    drawn = task.has_exact_sampler() and not (starts and task.feasible_file.exists())
    known = _draw_starts(task) if drawn else _read_starts(task) if starts else np.zeros((0, len(goal)))
    source = "of its own sample_feasible" if drawn else f"of {task.feasible_file}"
    _check_values(task, np.concatenate([goal[None], known]), source)
    _check_settling(task, goal)


def check_search(cls: type[Task]) -> FeasibleConfig:
    """The settings of ``python -m rcg_jax.feasible`` that a task class asks for by its ``search``.

    Raises:
        ContractError: it is no mapping, or names or values in it are none of these settings'.
    """
    if not isinstance(cls.search, Mapping):
        refuse(cls, f"search is {_kind(cls.search)}: must be a dict of settings of python -m rcg_jax.feasible")
    try:
        return parse_arguments(FeasibleConfig, search_words(cls))
    except ConfigError as error:
        refuse(cls, f"search: {one_line(error)}", error)


def _check_signatures(task: Task) -> None:
    """What the functions of a state return, traced one by one: an exception then names its function."""
    snapshot = _snapshot_shape(task)
    observation = _traced(task, "observe", snapshot)
    if not hasattr(observation, "shape") or len(observation.shape) != 1 or not observation.shape[0]:
        refuse(type(task), f"observe returns {_kind(observation)}: must be an array of shape (obs_dim,)")
    if not jnp.issubdtype(observation.dtype, jnp.floating):
        refuse(type(task), f"observe returns {_kind(observation)}: must be floating point")
    try:
        task.observation_parts()
    except Exception as error:
        reason = one_line(error) if isinstance(error, ValueError) else f"observation: {describe(error)}"
        refuse(type(task), reason, error)
    distance = _traced(task, "distance", snapshot)
    if getattr(distance, "shape", None) != () or not jnp.issubdtype(distance.dtype, jnp.floating):
        refuse(type(task), f"distance returns {_kind(distance)}: must be one floating point number, shape ()")
    for name in ("is_goal", "is_feasible", "is_failure"):
        _check_truth(task, name, _traced(task, name, snapshot))
    composition = _traced(task, "composition", snapshot)
    if not isinstance(composition, dict) or not composition:
        refuse(type(task), f"composition returns {_kind(composition)}: must be a dict of names and truth values")
    for name, value in composition.items():
        _check_truth(task, f"composition[{name!r}]", value)
    point = _traced(task, "point", snapshot)
    if point is not None and (getattr(point, "shape", None) != (3,) or not jnp.issubdtype(point.dtype, jnp.floating)):
        refuse(type(task), f"point returns {_kind(point)}: must be a floating point array of shape (3,), or None")
    _check_grid(task, _traced(task, "grid_coordinates", jnp.zeros((_SAMPLE, task.model.nq))), (_SAMPLE, task.model.nq))
    if task.has_exact_sampler():
        _check_sampler(task)


def _check_grid(task: Task, found: Any, shape: tuple[int, ...]) -> None:
    if len(getattr(found, "shape", ())) != 2 or found.shape[0] != shape[0]:
        refuse(
            type(task),
            f"grid_coordinates returns {_kind(found)} for positions of shape {shape}: must be (C, d)",
        )


def _check_sampler(task: Task) -> None:
    """What a task's own ``sample_feasible`` returns for a number that nobody would hit by chance."""
    cls, num = type(task), _SAMPLE + 1
    found = _traced(task, "sample_feasible", jax.random.key(0), num)
    if not isinstance(found, StartSet):
        refuse(cls, f"sample_feasible returns {_kind(found)}: must be a StartSet, as of rcg_jax.types.StartSet.at_rest")
    for name, shape in (("qpos", (num, task.model.nq)), ("qvel", (num, task.model.nv)), ("valid", (num,))):
        part = getattr(found, name)
        kind = bool if name == "valid" else jnp.floating
        if getattr(part, "shape", None) != shape or not jnp.issubdtype(part.dtype, kind):
            refuse(
                cls,
                f"sample_feasible(key, {num}) returns {name} of {_kind(part)}: must be of shape {shape}, type "
                f"{'bool' if kind is bool else 'float32'}",
            )


def _check_truth(task: Task, name: str, value: Any) -> None:
    if getattr(value, "shape", None) != () or value.dtype != bool:
        refuse(type(task), f"{name} returns {_kind(value)}: must be one truth value, shape () and type bool")


def _kind(value: Any) -> str:
    if hasattr(value, "shape"):
        return f"shape {value.shape}, type {value.dtype}"
    return f"a {type(value).__name__}"


def _traced(task: Task, name: str, argument: Any, *static: int) -> Any:
    """The shapes that the function ``name`` returns for an argument, by default of one state."""
    try:
        return jax.eval_shape(lambda x: getattr(task, name)(x, *static), argument)
    except Exception as error:
        refuse(type(task), f"{name} fails{place(type(task), error)}: {describe(error)}", error)


def _snapshot_shape(task: Task) -> Snapshot:
    batch = jax.eval_shape(lambda: task.snapshot(task.reset(task.goal_starts())))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), batch)


def _read_starts(task: Task) -> np.ndarray:
    """Some feasible starts (K, nq), evenly through their file."""
    try:
        qpos = np.asarray(task.feasible_starts().qpos)
    except (FileNotFoundError, StartsFileError) as error:
        raise ContractError(one_line(error)) from None
    return qpos[np.unique(np.linspace(0, len(qpos) - 1, min(_SAMPLE, len(qpos))).astype(int))]


def _draw_starts(task: Task) -> np.ndarray:
    """Some feasible starts (K, nq) from the exact sampler."""
    try:
        drawn = jax.tree.map(np.asarray, task.sample_feasible(jax.random.key(0), _SAMPLE))
    except Exception as error:
        refuse(type(task), f"sample_feasible fails{place(type(task), error)}: {describe(error)}", error)
    if not drawn.valid.all():
        refuse(type(task), f"sample_feasible marks {np.sum(~drawn.valid)} of {_SAMPLE} starts as not valid")
    return drawn.qpos  # type: ignore[no-any-return]


def _check_values(task: Task, qpos: np.ndarray, source: str) -> None:
    """The functions' values at the goal state, which is row 0 of (K + 1, nq), and at K feasible starts ``source``."""
    cls = type(task)

    @jit
    def values(qpos: jax.Array, qvel: jax.Array) -> dict[str, jax.Array]:
        s = task.snapshot(reset(qpos, qvel))
        names = ("observe", "distance", "is_goal", "is_feasible", "is_failure")
        return {name: jax.vmap(getattr(task, name))(s) for name in names}

    padded = np.resize(qpos, (_SAMPLE + 1, qpos.shape[1]))  # one shape, so that the compilation cache knows it
    at_rest = jnp.zeros((len(padded), task.model.nv))
    found = {k: np.asarray(x)[: len(qpos)] for k, x in values(jnp.asarray(padded, jnp.float32), at_rest).items()}
    far = f"where distance is {found['distance'][0]:.4g}"
    if not np.isfinite(found["distance"][0]) or found["distance"][0] < 0:
        refuse(cls, f"distance is {found['distance'][0]:g} at goal_state: must be finite and >= 0")
    if not found["is_goal"][0]:
        refuse(cls, f"is_goal is False at goal_state, {far}: the goal state has to be in the goal set")
    if not found["is_feasible"][0]:
        refuse(cls, f"is_feasible is False at goal_state, {far}: walks begin there and end where it is False")
    if found["is_failure"][0]:
        refuse(cls, f"is_failure is True at goal_state, {far}: the goal state must not be a failure")
    _check_starts(task, qpos, found, source)
    moving = [np.resize(x, (len(padded), x.shape[1])) for x in random_states(task, qpos[0], _SAMPLE)]
    seen = {name: np.asarray(x) for name, x in values(*(jnp.asarray(x, jnp.float32) for x in moving)).items()}
    for name in ("observe", "distance"):
        fine = np.isfinite(seen[name]).reshape(len(padded), -1).all(axis=0)
        never = np.flatnonzero(~np.isfinite(seen[name]).reshape(len(padded), -1).any(axis=0))
        if not fine.all() and len(never):
            which = f" (entry {never[0]})" if name == "observe" else ""
            refuse(
                cls,
                f"{name}{which} is not finite in any of {_SAMPLE} states that random actions lead to from "
                "goal_state: must be finite where the model moves, too",
            )
    try:
        grid = np.asarray(task.grid_coordinates(padded.astype(np.float32)), float)
    except Exception as error:
        refuse(cls, f"grid_coordinates fails{place(cls, error)} for NumPy's arrays: {describe(error)}", error)
    _check_grid(task, grid, padded.shape)
    if not np.isfinite(grid).all():
        row, column = np.argwhere(~np.isfinite(grid))[0]
        refuse(cls, f"grid_coordinates is {grid[row, column]} at {np.round(padded[row], 4).tolist()}: must be finite")


def _check_settling(task: Task, goal: np.ndarray) -> None:
    """In C MuJoCo. The goal state is a start itself: nearby ones would not stay, either, where it does not."""
    if not task.settle_steps:
        return
    qpos, qvel = roll_out(task.model, goal, task.settle_steps, neutral_ctrl(task, goal))

    @jit
    def stays(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        s = task.snapshot(reset(qpos, qvel))
        return jax.vmap(task.is_feasible)(s) & ~jax.vmap(task.is_failure)(s)

    finite = np.isfinite(qpos).all(axis=1) & np.isfinite(qvel).all(axis=1)
    fine = finite & np.asarray(stays(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)))
    if not fine.all():
        refuse(
            type(task),
            f"goal_state stays feasible for {np.argmin(fine)} steps of the neutral action: settle_steps = "
            f"{task.settle_steps} asks for more; a smaller one, or a goal state that stands by itself",
        )


def _check_starts(task: Task, qpos: np.ndarray, found: dict[str, np.ndarray], source: str) -> None:
    """Observations and distances are finite everywhere, and the starts are those of this task."""
    cls = type(task)
    for name in ("observe", "distance"):
        fine = np.isfinite(found[name]).reshape(len(qpos), -1)
        if not fine.all():
            row, column = np.argwhere(~fine)[0]
            where = "goal_state" if row == 0 else f"the feasible start {np.round(qpos[row], 4).tolist()}"
            which = f" (entry {column})" if name == "observe" else ""
            refuse(cls, f"{name} is {np.ravel(found[name][row])[column]}{which} at {where}: must be finite")
    outside = ~found["is_feasible"][1:] | found["is_failure"][1:]
    if len(outside) and outside.mean() > _OUTSIDE:
        advice = ""
        if str(task.feasible_file) in source:
            advice = ": they belong to another version of the task; generate them again, with overwrite=true"
        refuse(cls, f"refuses {outside.sum()} of {len(outside)} starts {source} (is_feasible, is_failure){advice}")


__all__ = ["ContractError", "build_task", "check_search", "check_task"]
