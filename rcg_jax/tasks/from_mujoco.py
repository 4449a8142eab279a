"""A task from a MuJoCo model alone, without writing a class."""

from __future__ import annotations

import copy
import numbers
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.config.settings import ConfigError
from rcg_jax.tasks.base import Task
from rcg_jax.types import Snapshot


def task_from_mujoco(
    model: str | Path | mujoco.MjSpec | mujoco.MjModel,
    *,
    point: str | tuple[str, Sequence[float]],
    target: str | tuple[str, Sequence[float]] | None = None,
    goal_state: str | Sequence[float] | np.ndarray | None = None,
    goal_radius: float = 0.03,
    is_goal: Callable[[Snapshot], Array] | None = None,
    observe: Callable[[Snapshot], Array] | None = None,
    sites: Sequence[str] | None = None,
    feasible_radius: float | None = None,
    is_feasible: Callable[[Snapshot], Array] | None = None,
    horizon: int = 500,
    settle_steps: int = 0,
    training: Mapping[str, Any] | None = None,
    search: Mapping[str, Any] | None = None,
    name: str = "",
) -> type[Task]:
    """A task class: a named point of the model has to come to where it is in the goal state.

        Peg = task_from_mujoco("peg.xml", point="peg_tip", goal_state="inserted", goal_radius=0.01)
        task = Peg("native")

    In a file, ``task=file.py:Peg`` uses it in every command. What is not given has a default; functions take a
    :class:`rcg_jax.types.Snapshot`, in jnp, as those of :class:`rcg_jax.Task` do.

    Args:
        model: MJCF file, relative to the caller's; or a model.
        point: site or body that the task is about; or a body and a place in its frame [m], ``("pole", (0, 0, 0.6))``.
        target: site, body or place, as ``point``, where it has to come to; by default the fixed place in the world
            where ``point`` is in the goal state.
        goal_state: s^g: name of a keyframe, or positions (nq,); by default the keyframe ``goal``.
        goal_radius: the goal set S^g, unless ``is_goal`` is given: how close the point has to come [m].
        is_goal: the goal set otherwise.
        observe: observation; by default positions, velocities, activations if there are any, and ``sites``.
        sites: names of the sites in it; by default those on bodies that move.
        feasible_radius: the region of S^0, unless ``is_feasible`` is given: how far the point may be from its goal [m];
            None: anywhere.
        is_feasible: the region otherwise.
        horizon: T [physics steps].
        settle_steps: see :class:`rcg_jax.Task`.
        training: settings of training by dotted name, such as ``{"policy.action_repeat": 4}``.
        search: settings of ``python -m rcg_jax.feasible``.
        name: of the task; by default the model's. Tasks of one model in one program need different ones, as their
            feasible starts lie under it; commands go by the variable.

    Raises:
        ConfigError: no such file, point, keyframe or site, or a number out of range; names what there is.
    """
    caller = _caller()
    folder = Path(caller["__file__"]).parent if "__file__" in caller else Path()
    spec = None if isinstance(model, mujoco.MjModel) else _spec(model, folder)
    compiled: mujoco.MjModel = spec.compile() if spec else model
    title = name or (compiled.names[: compiled.names.find(b"\0")].decode() or "Model")
    refuse = f"task_from_mujoco({title})"
    for label, value in (("goal_radius", goal_radius), ("feasible_radius", feasible_radius)):
        if value is not None and not (isinstance(value, numbers.Real) and 0 < value < np.inf):
            raise ConfigError(f"{refuse}: {label}={value!r}: must be a finite number > 0")
    goal = _goal(compiled, goal_state, refuse)
    where = finder(compiled, "point", point, refuse)
    holder, moves = point if isinstance(point, str) else point[0], [x for names in moving(compiled) for x in names]
    if is_goal is None and target is None and holder not in moves:
        raise ConfigError(f"{refuse}: point={spoken(point)}: does not move; those that do are {listed(moves)}")
    shown = _sites(compiled, sites, refuse)
    if target is None:
        place = point_at(compiled, goal, where).astype(np.float32)  # NumPy: no backend is started here
        end = lambda s: place  # noqa: E731
        to = "where it is in the goal state"
    else:
        end, to = finder(compiled, "target", target, refuse), spoken(target)

    def distance(self: Task, s: Snapshot) -> Array:
        return jnp.linalg.norm(where(s) - end(s))

    def default_observe(self: Task, s: Snapshot) -> Array:
        act = [] if s.act is None else [s.act]
        return jnp.concatenate([s.qpos, s.qvel, *act, s.site_xpos[shown].ravel()])

    parts = [("positions", compiled.nq, "rad, m", "data.qpos"), ("velocities", compiled.nv, "rad/s, m/s", "data.qvel")]
    parts += [("activations", compiled.na, "", "data.act")] if compiled.na else []
    parts += [(compiled.site(i).name, 3, "m", f"data.site({compiled.site(i).name!r}).xpos") for i in shown]
    body: dict[str, Any] = {
        "__module__": caller["__name__"],
        "__doc__": f"{spoken(point)} of {title} has to come to {to}.",
        "name": title,
        "horizon": horizon,
        "settle_steps": settle_steps,
        "training": dict(training or {}),
        "search": dict(search or {}),
        "point_name": spoken(point),
        "observation": () if observe else tuple(parts),
        "goal_state": property(lambda self: goal),
        "distance": distance,
        "point": lambda self, s: where(s),
        "observe": (lambda self, s: observe(s)) if observe else default_observe,
        "is_goal": (lambda self, s: is_goal(s)) if is_goal else lambda self, s: distance(self, s) < goal_radius,
        "is_feasible": (lambda self, s: is_feasible(s)) if is_feasible else _within(distance, feasible_radius),
    }
    if spec:
        body["make_spec"] = lambda self: spec.copy()
    else:
        body["make_model"] = lambda self: copy.copy(model)
    return type(title, (_FromModel,), body)


class _FromModel(Task):
    """A class that :func:`task_from_mujoco` made."""

    spelling = ""

    @classmethod
    def spelled(cls) -> str:
        return cls.spelling or super().spelled()

    @classmethod
    def rename(cls, name: str) -> None:
        """The class is a variable ``name`` of its file: feasible starts lie under that name, commands find it so."""
        source = cls.source()
        if cls.__qualname__ != name and source is not None:
            cls.__name__ = cls.__qualname__ = name
            cls.feasible_file = source.parent / f"{source.stem}.{name}.npz"


def _spec(model: Any, folder: Path) -> mujoco.MjSpec:
    if isinstance(model, mujoco.MjSpec):
        return model.copy()
    path = folder / Path(model).expanduser()
    if not path.is_file():
        raise ConfigError(f"task_from_mujoco: no such file: {path}")
    return mujoco.MjSpec.from_file(str(path))


def _goal(model: mujoco.MjModel, goal_state: Any, refuse: str) -> np.ndarray:
    """Positions of the goal state."""
    if goal_state is None or isinstance(goal_state, str):
        keys = [model.key(i).name for i in range(model.nkey)]
        wanted = goal_state or "goal"
        if wanted not in keys:
            raise ConfigError(f"{refuse}: goal_state={wanted}: must be positions or a keyframe; it has {listed(keys)}")
        return np.array(model.key(wanted).qpos)
    qpos = np.array(goal_state, float)
    if qpos.shape != (model.nq,) or not np.isfinite(qpos).all():
        found = f"of shape {qpos.shape}" if qpos.shape != (model.nq,) else qpos.tolist()
        raise ConfigError(f"{refuse}: goal_state: must be {model.nq} finite positions, not {found}")
    return qpos


def spoken(point: str | tuple[str, Sequence[float]]) -> str:
    """What ``point`` or ``target`` says, in words."""
    return point if isinstance(point, str) else f"{point[0]} at {' '.join(f'{x:g}' for x in point[1])}"


def finder(
    model: mujoco.MjModel, field: str, point: str | tuple[str, Sequence[float]], refuse: str
) -> Callable[[Any], Any]:
    """A function that takes a Snapshot, or an MjData, to the position (3,) of a site, body or place.

    Raises:
        ConfigError: there is none; names those that there are.
    """
    kinds = mujoco.mjtObj
    if isinstance(point, str) and (site := mujoco.mj_name2id(model, kinds.mjOBJ_SITE, point)) >= 0:
        return lambda s: s.site_xpos[site]
    name, place = (point, None) if isinstance(point, str) else (point[0], np.array(point[1], np.float32))
    body = mujoco.mj_name2id(model, kinds.mjOBJ_BODY, name)
    if body < 0:
        what = "a site or body" if place is None else "a body and a place in its frame"
        bodies = [model.body(i).name for i in range(1, model.nbody)]
        sites = [model.site(i).name for i in range(model.nsite)] if place is None else []
        raise ConfigError(f"{refuse}: {field}={spoken(point)}: must be {what}; it has {listed(sites + bodies)}")
    if place is None:
        return lambda s: s.xpos[body]
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ConfigError(f"{refuse}: {field}={spoken(point)}: the place must be three finite numbers")
    return lambda s: s.xpos[body] + s.xmat[body].reshape(3, 3) @ place


def point_at(model: mujoco.MjModel, qpos: np.ndarray, point: Callable[[Any], Any]) -> np.ndarray:
    """Where a point is, (3,) [m], at positions (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return np.array(point(data))


def _caller() -> dict[str, Any]:
    """The globals of who called the function of this package that makes a task."""
    frame = sys._getframe(2)
    while frame.f_back and frame.f_globals["__name__"].startswith(f"{__package__}.from_"):
        frame = frame.f_back
    return frame.f_globals


def _sites(model: mujoco.MjModel, sites: Sequence[str] | None, refuse: str) -> np.ndarray:
    """Numbers of the sites that are observed."""
    known = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
    if sites is None:
        return np.array([known[name] for name in moving(model)[0]], int)
    for name in sites:
        if name not in known:
            raise ConfigError(f"{refuse}: sites: no site {name}; it has {listed(list(known))}")
    return np.array([known[name] for name in sites], int)


def _within(distance: Callable[[Task, Snapshot], Array], radius: float | None) -> Callable[[Task, Snapshot], Array]:
    if radius is None:
        return lambda self, s: jnp.ones((), bool)
    return lambda self, s: distance(self, s) < radius


def moving(model: mujoco.MjModel) -> tuple[list[str], list[str]]:
    """The names of the sites, and of the bodies, that move."""
    moves = (model.body_weldid != 0) & (model.body_mocapid[model.body_weldid] < 0)
    sites = [model.site(i).name for i in range(model.nsite) if moves[model.site_bodyid[i]]]
    bodies = [model.body(i).name for i in np.flatnonzero(moves)]
    return [name for name in sites if name], [name for name in bodies if name]


def listed(names: Sequence[str]) -> str:
    """Names in words."""
    return ", ".join(name for name in names if name) or "none with a name"
