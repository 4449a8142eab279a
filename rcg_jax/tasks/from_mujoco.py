"""A task from a MuJoCo model alone, without writing a class."""

from __future__ import annotations

import copy
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
    point: str,
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
        point: site or body that the task is about.
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
    caller = sys._getframe(1).f_globals
    folder = Path(caller["__file__"]).parent if "__file__" in caller else Path()
    spec = None if isinstance(model, mujoco.MjModel) else _spec(model, folder)
    compiled: mujoco.MjModel = spec.compile() if spec else model
    title = name or (compiled.names[: compiled.names.find(b"\0")].decode() or "Model")
    refuse = f"task_from_mujoco({title})"
    for label, value in (("goal_radius", goal_radius), ("feasible_radius", feasible_radius)):
        if value is not None and not 0 < value < np.inf:
            raise ConfigError(f"{refuse}: {label}={value}: must be a finite number > 0")
    goal = _goal(compiled, goal_state, refuse)
    where = _finder(compiled, point, refuse)
    shown = _sites(compiled, sites, refuse)
    data = mujoco.MjData(compiled)
    data.qpos[:] = goal
    mujoco.mj_kinematics(compiled, data)
    target = _position(data, compiled, point).astype(np.float32)  # NumPy: no backend is started here

    def distance(self: Task, s: Snapshot) -> Array:
        return jnp.linalg.norm(where(s) - target)

    def default_observe(self: Task, s: Snapshot) -> Array:
        act = [] if s.act is None else [s.act]
        return jnp.concatenate([s.qpos, s.qvel, *act, s.site_xpos[shown].ravel()])

    parts = [("positions", compiled.nq, "rad, m", "data.qpos"), ("velocities", compiled.nv, "rad/s, m/s", "data.qvel")]
    parts += [("activations", compiled.na, "", "data.act")] if compiled.na else []
    parts += [(compiled.site(i).name, 3, "m", f"data.site({compiled.site(i).name!r}).xpos") for i in shown]
    body: dict[str, Any] = {
        "__module__": caller["__name__"],
        "__doc__": f"{point} of {title} has to come to where it is in the goal state.",
        "name": title,
        "horizon": horizon,
        "settle_steps": settle_steps,
        "training": dict(training or {}),
        "search": dict(search or {}),
        "point_name": point,
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
            raise ConfigError(f"{refuse}: goal_state={wanted}: must be positions or a keyframe; it has {_list(keys)}")
        return np.array(model.key(wanted).qpos)
    qpos = np.array(goal_state, float)
    if qpos.shape != (model.nq,) or not np.isfinite(qpos).all():
        raise ConfigError(f"{refuse}: goal_state: must be {model.nq} finite positions, not of shape {qpos.shape}")
    return qpos


def _finder(model: mujoco.MjModel, point: str, refuse: str) -> Callable[[Snapshot], Array]:
    site, body = (
        mujoco.mj_name2id(model, kind, point) for kind in (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY)
    )
    if site < 0 and body < 0:
        names = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
        raise ConfigError(f"{refuse}: point={point}: must be a site or body; it has {_list(names)}")
    return (lambda s: s.site_xpos[site]) if site >= 0 else (lambda s: s.xpos[body])


def _position(data: mujoco.MjData, model: mujoco.MjModel, point: str) -> np.ndarray:
    is_site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, point) >= 0
    return np.array(data.site(point).xpos if is_site else data.body(point).xpos)


def _sites(model: mujoco.MjModel, sites: Sequence[str] | None, refuse: str) -> np.ndarray:
    """Numbers of the sites that are observed."""
    known = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
    if sites is None:
        root = model.body_weldid[model.site_bodyid]
        return np.array([i for i in known.values() if root[i] != 0 and model.body_mocapid[root[i]] < 0], int)
    for name in sites:
        if name not in known:
            raise ConfigError(f"{refuse}: sites: no site {name}; it has {_list(list(known))}")
    return np.array([known[name] for name in sites], int)


def _within(distance: Callable[[Task, Snapshot], Array], radius: float | None) -> Callable[[Task, Snapshot], Array]:
    if radius is None:
        return lambda self, s: jnp.ones((), bool)
    return lambda self, s: distance(self, s) < radius


def _list(names: Sequence[str]) -> str:
    return ", ".join(name for name in names if name) or "none with a name"
