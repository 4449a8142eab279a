"""What a task's model and goal state must be, see :mod:`rcg_jax.tasks.check`, and how a breach is put."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import jax.numpy as jnp
import mujoco
import numpy as np

from rcg_jax.config.load_class import describe, line_in
from rcg_jax.config.search import FeasibleConfig
from rcg_jax.config.settings import ConfigError
from rcg_jax.physics.kinematics import quaternions
from rcg_jax.physics.silence import silence
from rcg_jax.physics.unsupported import hidden_state, name_of
from rcg_jax.tasks.base import Task

#: How far a quaternion's length may be from 1.
_UNIT = 1e-3

#: Steps of random actions before the next ones begin in the goal state again.
_EPISODE = 32

_KIND, _JOINT = mujoco.mjtObj, mujoco.mjtJoint


class ContractError(ConfigError):
    """A task that cannot be trained. The message is one line that says where, what and which value."""


def refuse(cls: type[Task], what: str, cause: BaseException | None = None) -> NoReturn:
    """Raises the :class:`ContractError` that ``what`` is wrong with a task class."""
    raise ContractError(f"task={cls.spelled()}: {what}") from cause


def refuse_exception(cls: type[Task], what: str, error: Exception) -> NoReturn:
    """Raises the :class:`ContractError` that ``what`` went wrong: in which line of the class's file, and why."""
    source = cls.source()
    line = line_in(error, source)
    where = f" ({source.name}, line {line})" if source and line else ""
    refuse(cls, f"{what}{where}: {describe(error)}", error)


@contextmanager
def explained(cls: type[Task], what: str) -> Iterator[None]:
    """Context in which exceptions of a class's own code are put by :func:`refuse_exception`."""
    try:
        yield
    except Exception as error:
        refuse_exception(cls, what, error)


def one_line(error: BaseException) -> str:
    """An exception's message."""
    return " ".join(str(error).split()) or type(error).__name__


def check_model(task: Task, search: FeasibleConfig) -> np.ndarray:
    """Checks the model and the goal state; returns s^g, (nq,) float."""
    _check_actuators(task)
    goal = _check_goal_state(task)
    _check_range(task, goal, search.max_excess)
    if deep := overlap(task.model, goal, search.max_depth):
        allowed = f"at most {search.max_depth:g} m is allowed (max_depth of its search)"
        refuse(type(task), f"goal_state is in penetration: {deep}; {allowed}")
    _check_one_step(task, goal)
    return goal


def _check_actuators(task: Task) -> None:
    """Actuators that actions in [-1, 1] can be scaled to, and no state that simulations would not carry."""
    cls, model = type(task), task.model
    if not model.nu:
        refuse(cls, "has a model without actuators: nothing can be learned")
    if what := hidden_state(model):
        refuse(cls, f"has a model with {what}: only positions, velocities and activations are state here")
    for i in np.flatnonzero(model.actuator_ctrlnum != 1).tolist():
        who = f"actuator {name_of(model, _KIND.mjOBJ_ACTUATOR, i)}"
        refuse(cls, f"has a model whose {who} has {model.actuator_ctrlnum[i]} controls: must be one")
    for i, (low, high) in enumerate(model.actuator_ctrlrange):
        who = f"actuator {name_of(model, _KIND.mjOBJ_ACTUATOR, i)}"
        if model.actuator_plugin[i] >= 0 and cls.neutral_action is Task.neutral_action:
            refuse(cls, f"has a model whose {who} is a plugin: the class has to give its neutral_action")
        if not model.actuator_ctrllimited[i]:
            refuse(cls, f"has a model whose {who} is not limited: give it a ctrlrange, actions in [-1, 1] scale to it")
        if not (np.isfinite([low, high]).all() and low < high):
            refuse(cls, f"has a model whose {who} has ctrlrange {low:g} {high:g}: must be two rising numbers")


def _check_goal_state(task: Task) -> np.ndarray:
    cls, model = type(task), task.model
    joints = [name_of(model, _KIND.mjOBJ_JOINT, i) for i in range(model.njnt)]
    with explained(cls, "goal_state cannot be had"):
        goal = np.asarray(task.goal_state, float)
    if goal.shape != (model.nq,):
        says = f"must be ({model.nq},), nq of its model (joints {', '.join(joints)})"
        refuse(cls, f"goal_state has shape {goal.shape}: {says}")
    if not np.isfinite(goal).all():
        refuse(cls, f"goal_state = {goal.tolist()}: must be finite")
    for joint, place in quaternions(model).items():
        length = np.linalg.norm(goal[place])
        if abs(length - 1) > _UNIT:
            where = f"at [{place.start}:{place.stop}] (joint {joints[joint]})"
            refuse(cls, f"goal_state has a quaternion of length {length:.4g} {where}: must be 1")
    return goal


def _check_range(task: Task, goal: np.ndarray, max_excess: float) -> None:
    """Joints and tendons at s^g are within their ranges, or beyond by as little as a search lets starts be."""
    model, data = task.model, mujoco.MjData(task.model)

    def check(what: str, value: float, low: float, high: float) -> None:
        if not low - max_excess <= value <= high + max_excess:
            refuse(type(task), f"goal_state has {what} {value:.6g}: must be in its range, {low:.6g} to {high:.6g}")

    data.qpos[:] = goal
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    for i in np.flatnonzero(model.tendon_limited):
        check(f"tendon {name_of(model, _KIND.mjOBJ_TENDON, i)} at", data.ten_length[i], *model.tendon_range[i])
    for i in np.flatnonzero(model.jnt_limited):
        joint, place = f"joint {name_of(model, _KIND.mjOBJ_JOINT, i)}", model.jnt_qposadr[i]
        if model.jnt_type[i] == _JOINT.mjJNT_BALL:
            w, *xyz = goal[place : place + 4]
            check(f"{joint} turned by", 2 * np.arctan2(np.linalg.norm(xyz), abs(w)), *model.jnt_range[i])
        else:
            check(f"{joint} at", goal[place], *model.jnt_range[i])


def overlap(model: mujoco.MjModel, qpos: np.ndarray, allowed: float = 0.0) -> str:
    """The geoms that are deepest inside each other at ``qpos`` (nq,), if by more than ``allowed`` [m]; else empty."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    try:
        with silence():
            mujoco.mj_forward(model, data)
    except mujoco.FatalError:
        return "more contacts than the model has memory for"
    if not data.ncon or -data.contact.dist.min() <= allowed:
        return ""
    k = int(np.argmin(data.contact.dist))
    pair = " and ".join(f"geom {name_of(model, _KIND.mjOBJ_GEOM, g)}" for g in data.contact.geom[k])
    return f"{pair} overlap by {-data.contact.dist[k]:.4g} m"


def _check_one_step(task: Task, goal: np.ndarray) -> None:
    """C MuJoCo's step from the goal state, at rest, under the neutral control; nothing to compile."""
    model, data = task.model, mujoco.MjData(task.model)
    data.qpos[:], data.act[:], data.ctrl[:] = goal, neutral_act_at(task, goal), neutral_ctrl(task, goal)
    try:
        with silence():
            mujoco.mj_step(model, data)
    except mujoco.FatalError as error:
        refuse(type(task), f"goal_state does not survive one step: {one_line(error)}", error)
    if not all((np.abs(x) < mujoco.mjMAXVAL).all() for x in (data.qpos, data.qvel, data.qacc, data.act)):
        refuse(
            type(task),
            f"goal_state does not survive one step of {model.opt.timestep:g} s: qvel = {data.qvel.tolist()}; a smaller "
            f"timestep, or a goal state without overlap ({overlap(model, goal) or 'there is none'})",
        )


def neutral_ctrl(task: Task, qpos: np.ndarray) -> np.ndarray:
    """The controls (nu,) of the task's neutral action at rest at ``qpos`` (nq,)."""
    low, high = task.model.actuator_ctrlrange.T
    action = np.asarray(task.neutral_action(jnp.asarray(qpos, jnp.float32)[None]), float)[0]
    return np.asarray(low + (action + 1) / 2 * (high - low))


def neutral_act_at(task: Task, qpos: np.ndarray) -> np.ndarray:
    """The activations (na,) at rest at ``qpos`` (nq,)."""
    starts = task.at_rest(jnp.asarray(qpos, jnp.float32)[None])
    return np.zeros(0) if starts.act is None else np.asarray(starts.act, float)[0]


def roll_out(
    model: mujoco.MjModel, qpos: np.ndarray, controls: np.ndarray, act: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """C MuJoCo from rest at ``qpos`` (nq,) and ``act`` (na,) under controls (K, nu).

    Positions (K, nq), velocities (K, nv) and, where the model has them, activations (K, na). NaN where MuJoCo cannot go
    on.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:] = qpos, 0.0 if act is None else act
    fields = [data.qpos, data.qvel, *([data.act] if model.na else [])]
    states = tuple(np.full((len(controls), len(field)), np.nan) for field in fields)
    with silence():
        for k, ctrl in enumerate(controls):
            data.ctrl[:] = ctrl
            try:
                mujoco.mj_step(model, data)
            except mujoco.FatalError:
                break
            for path, field in zip(states, fields, strict=True):
                path[k] = field
    return states


def random_states(task: Task, qpos: np.ndarray, num: int) -> tuple[np.ndarray, ...]:
    """What random actions lead to from rest at ``qpos``, in C MuJoCo: as :func:`roll_out`, ``num`` states."""
    low, high = task.model.actuator_ctrlrange.T
    controls = np.random.default_rng(0).uniform(low, high, (num, task.model.nu))
    act = neutral_act_at(task, qpos)
    parts = [roll_out(task.model, qpos, controls[k : k + _EPISODE], act) for k in range(0, num, _EPISODE)]
    return tuple(map(np.concatenate, zip(*parts, strict=True)))
