"""What a task must be, checked before anything large is compiled. A breach is one sentence: where, what, the value."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Mapping
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
from rcg_jax.tasks.check_model import ContractError as ContractError
from rcg_jax.tasks.check_model import (
    check_model,
    explained,
    neutral_act_at,
    neutral_ctrl,
    one_line,
    random_states,
    refuse,
    refuse_exception,
    roll_out,
)
from rcg_jax.types import StartSet, concatenate

#: Feasible starts that stand for all of them in the check, and the share that may lie outside the region: states on
#: its edge fall to either side on another machine.
_SAMPLE, _OUTSIDE = 256, 0.02

#: Where feasible starts that no file holds come from.
_SAMPLER = "its own sample_feasible"


def search_words(task: Task | type[Task]) -> list[str]:
    """The settings that a task's ``search``, or else its ``settle_steps``, asks for, as the command line would."""
    settle = {"settle_steps": task.settle_steps} if task.settle_steps else {}
    return [f"{name}={value}" for name, value in {**settle, **task.search}.items()]


def build_task(cls: type[Task], engine: str) -> Task:
    """An instance of a task class on a physics engine.

    Raises:
        ContractError: the class is incomplete, its model cannot be loaded, or the engine cannot simulate it.
        Exception: as :func:`rcg_jax.physics.check_engine`.
    """
    check_engine(engine)  # before the class's own code runs, which may raise anything
    from_file = (cls.make_model, cls.make_spec) == (Task.make_model, Task.make_spec)
    missing = sorted(cls.__abstractmethods__)
    if from_file and not hasattr(cls, "xml"):
        missing.insert(0, "xml")
    if missing:
        refuse(cls, f"lacks {', '.join(missing)}; every task has to give {'it' if len(missing) == 1 else 'them'}")
    if from_file and not cls.xml.is_file():
        refuse(cls, f"xml: no such file: {cls.xml}")
    try:
        with jax.ensure_compile_time_eval():  # it may be built inside a jit
            return cls(engine)
    except UnsupportedModelError as error:
        refuse(cls, f"engine={engine}: {one_line(error)}", error)
    except Exception as error:
        refuse_exception(cls, "cannot be built", error)


def check_task(task: Task, *, starts: bool = True) -> None:
    """Checks a task against the contract of :class:`rcg_jax.tasks.Task`, in a second or two.

    With ``starts`` its feasible starts have to be there, too.

    Raises:
        ContractError: the first breach.
    """
    cls = type(task)
    for name, least, what in (
        ("horizon", 1, "physics steps per episode"),
        ("settle_steps", 0, "steps that a start at rest stays feasible"),
    ):
        value = getattr(task, name)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < least:
            refuse(cls, f"{name} = {value!r}: must be an integer >= {least}, {what}")
    search = check_search(cls)
    goal = check_model(task, search)
    _check_signatures(task)
    known, source = _known_starts(task, starts)
    at_goal, values = task.at_rest(jnp.asarray(goal, jnp.float32)[None]), _make_values(task)
    states = concatenate(at_goal, known) if known else at_goal
    qpos = np.concatenate([goal[None], np.asarray(states.qpos[1:], float)])
    act = [] if states.act is None else [np.asarray(states.act)]
    _check_values(cls, qpos, values(qpos, np.zeros((len(qpos), task.model.nv)), *act), source)
    _check_moving(cls, values(*random_states(task, goal, _SAMPLE)))
    _check_grid_values(task, qpos)
    _check_settling(task, goal, values)


def check_search(cls: type[Task]) -> FeasibleConfig:
    """The settings of ``python -m rcg_jax.feasible`` that a task class asks for; a ContractError says what is wrong."""
    if not isinstance(cls.search, Mapping):
        refuse(cls, f"search is {_kind(cls.search)}: must be a dict of settings of python -m rcg_jax.feasible")
    try:
        return parse_arguments(FeasibleConfig, search_words(cls))
    except ConfigError as error:
        refuse(cls, f"search: {one_line(error)}", error)


def _kind(value: Any) -> str:
    if hasattr(value, "shape"):
        return f"shape {value.shape}, type {value.dtype}"
    return f"a {type(value).__name__}"


def _traced(task: Task, name: str, argument: Any, *static: int) -> Any:
    """The shapes that the function ``name`` returns, traced by itself: an exception then names it."""
    with explained(type(task), f"{name} fails"):
        return jax.eval_shape(lambda x: getattr(task, name)(x, *static), argument)


def _check_array(task: Task, what: str, value: Any, shape: tuple[int, ...], kind: Any, *, must: str) -> None:
    if getattr(value, "shape", None) != shape or not jnp.issubdtype(value.dtype, kind):
        refuse(type(task), f"{what} {_kind(value)}: must be {must}")


def _check_signatures(task: Task) -> None:
    """What the functions of a state return."""
    cls, real = type(task), jnp.floating
    batch = jax.eval_shape(lambda: task.snapshot(task.reset(task.goal_starts())))
    snapshot = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), batch)
    truth = "one truth value, shape () and type bool"
    observation = _traced(task, "observe", snapshot)
    if len(getattr(observation, "shape", ())) != 1 or not observation.shape[0]:
        refuse(cls, f"observe returns {_kind(observation)}: must be an array of shape (obs_dim,)")
    _check_array(task, "observe returns", observation, observation.shape, real, must="floating point")
    try:
        task.observation_parts()
    except Exception as error:
        reason = one_line(error) if isinstance(error, ValueError) else f"observation: {describe(error)}"
        refuse(cls, reason, error)
    distance = _traced(task, "distance", snapshot)
    _check_array(task, "distance returns", distance, (), real, must="one floating point number, shape ()")
    for name in ("is_goal", "is_feasible", "is_failure"):
        _check_array(task, f"{name} returns", _traced(task, name, snapshot), (), bool, must=truth)
    composition = _traced(task, "composition", snapshot)
    if not isinstance(composition, dict) or not composition:
        refuse(cls, f"composition returns {_kind(composition)}: must be a dict of names and truth values")
    for name, value in composition.items():
        _check_array(task, f"composition[{name!r}] returns", value, (), bool, must=truth)
    point = _traced(task, "point", snapshot)
    if point is not None:
        _check_array(task, "point returns", point, (3,), real, must="a floating point array of shape (3,), or None")
    positions = jnp.zeros((_SAMPLE, task.model.nq))
    grid = _traced(task, "grid_coordinates", positions)
    if len(getattr(grid, "shape", ())) != 2 or grid.shape[0] != _SAMPLE:
        returned = f"returns {_kind(grid)} for positions of shape {positions.shape}"
        refuse(cls, f"grid_coordinates {returned}: must be (C, d)")
    if task.has_exact_sampler():
        _check_sampler(task)


def _check_sampler(task: Task) -> None:
    """What a task's own ``sample_feasible`` returns for a number that nobody would hit by chance."""
    num = _SAMPLE + 1
    found = _traced(task, "sample_feasible", jax.random.key(0), num)
    if not isinstance(found, StartSet):
        must = "must be a StartSet, as of rcg_jax.types.StartSet.at_rest"
        refuse(type(task), f"sample_feasible returns {_kind(found)}: {must}")
    shapes = {"qpos": (num, task.model.nq), "qvel": (num, task.model.nv), "valid": (num,)}
    if task.model.na:
        shapes["act"] = (num, task.model.na)
    for name, shape in shapes.items():
        kind, word = (bool, "bool") if name == "valid" else (jnp.floating, "float32")
        what = f"sample_feasible(key, {num}) returns {name} of"
        _check_array(task, what, getattr(found, name), shape, kind, must=f"of shape {shape}, type {word}")


def _known_starts(task: Task, starts: bool) -> tuple[StartSet | None, str]:
    """Some feasible starts, of an exact sampler or evenly through their file, and where they come from."""
    if task.has_exact_sampler() and not (starts and task.feasible_file.exists()):
        with explained(type(task), "sample_feasible fails"):
            drawn = jax.tree.map(np.asarray, task.sample_feasible(jax.random.key(0), _SAMPLE))
        if not drawn.valid.all():
            refuse(type(task), f"sample_feasible marks {np.sum(~drawn.valid)} of {_SAMPLE} starts as not valid")
        return drawn, _SAMPLER
    if not starts:
        return None, ""
    try:
        known = task.feasible_starts()
    except (FileNotFoundError, StartsFileError) as error:
        raise ContractError(one_line(error)) from None
    rows = np.linspace(0, known.capacity - 1, min(_SAMPLE, known.capacity)).astype(int)
    return known.take(jnp.asarray(rows)), str(task.feasible_file)


Values = dict[str, np.ndarray]


def _make_values(task: Task) -> Callable[..., Values]:
    """A function of states (K, nq), (K, nv), maybe (K, na), that gives the values of the task's functions, by name."""

    @jit
    def compute(*state: jax.Array) -> dict[str, jax.Array]:
        s = task.snapshot(reset(*state))
        names = ("observe", "distance", "is_goal", "is_feasible", "is_failure")
        return {name: jax.vmap(getattr(task, name))(s) for name in names}

    def values(*state: np.ndarray) -> Values:
        num = max(len(state[0]), _SAMPLE + 1)  # one shape, so that the compilation cache knows it
        padded = (jnp.asarray(np.resize(x, (num, x.shape[1])), jnp.float32) for x in state)
        return {name: np.asarray(x)[: len(state[0])] for name, x in compute(*padded).items()}

    return values


def _check_values(cls: type[Task], qpos: np.ndarray, found: Values, source: str) -> None:
    """The values at the goal state, which is row 0 of (K + 1, nq), and at K feasible starts of ``source``."""
    distance = found["distance"][0]
    if not np.isfinite(distance) or distance < 0:
        refuse(cls, f"distance is {distance:g} at goal_state: must be finite and >= 0")
    for name, wrong, why in (
        ("is_goal", False, "the goal state has to be in the goal set"),
        ("is_feasible", False, "walks begin there and end where it is False"),
        ("is_failure", True, "the goal state must not be a failure"),
    ):
        if found[name][0] == wrong:
            refuse(cls, f"{name} is {wrong} at goal_state, where distance is {distance:.4g}: {why}")

    for name in ("observe", "distance"):
        values = found[name].reshape(len(qpos), -1)
        for row, column in np.argwhere(~np.isfinite(values)):
            where = f"the feasible start {np.round(qpos[row], 4).tolist()}" if row else "goal_state"
            entry = f" (entry {column})" if name == "observe" else ""
            refuse(cls, f"{name} is {values[row, column]}{entry} at {where}: must be finite")

    outside = ~found["is_feasible"][1:] | found["is_failure"][1:]
    if len(outside) and outside.mean() > _OUTSIDE:
        again = ": they belong to another version of the task; generate them again, with overwrite=true"
        advice = "" if source == _SAMPLER else again
        refuse(cls, f"refuses {outside.sum()} of {len(outside)} starts of {source} (is_feasible, is_failure){advice}")


def _check_moving(cls: type[Task], seen: Values) -> None:
    """Observations and distances are finite in some states, at least, that the model moves through."""
    states = f"any of {_SAMPLE} states that random actions lead to from goal_state"
    for name in ("observe", "distance"):
        never = np.flatnonzero(~np.isfinite(seen[name]).reshape(_SAMPLE, -1).any(axis=0))
        if len(never):
            entry = f" (entry {never[0]})" if name == "observe" else ""
            refuse(cls, f"{name}{entry} is not finite in {states}: must be finite where the model moves, too")


def _check_grid_values(task: Task, qpos: np.ndarray) -> None:
    """Grid coordinates of NumPy's arrays."""
    with explained(type(task), "grid_coordinates of NumPy's arrays fails"):
        grid = np.asarray(task.grid_coordinates(qpos.astype(np.float32)), float)
    for row, column in np.argwhere(~np.isfinite(grid)):
        where = np.round(qpos[row], 4).tolist()
        refuse(type(task), f"grid_coordinates is {grid[row, column]} at {where}: must be finite")


def _check_settling(task: Task, goal: np.ndarray, values: Callable[..., Values]) -> None:
    """In C MuJoCo. The goal state is a start itself: nearby ones would not stay, either, where it does not."""
    if not task.settle_steps:
        return
    controls = np.tile(neutral_ctrl(task, goal), (task.settle_steps, 1))
    states = roll_out(task.model, goal, controls, neutral_act_at(task, goal))
    found = values(*states)
    stays = found["is_feasible"] & ~found["is_failure"] & np.isfinite(np.hstack(states)).all(axis=1)
    if not stays.all():
        refuse(
            type(task),
            f"goal_state stays feasible for {np.argmin(stays)} steps of the neutral action: settle_steps = "
            f"{task.settle_steps} asks for more; a smaller one, or a goal state that stands by itself",
        )
