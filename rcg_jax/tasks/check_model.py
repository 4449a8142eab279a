"""What a task's model and goal state must be, see :mod:`rcg_jax.tasks.check`, and how a breach is put."""

from __future__ import annotations

from contextlib import suppress
from typing import NoReturn

import jax.numpy as jnp
import mujoco
import numpy as np

from rcg_jax.config.load_class import describe, line_in
from rcg_jax.config.settings import ConfigError
from rcg_jax.physics.silence import silence
from rcg_jax.physics.unsupported import hidden_state
from rcg_jax.physics.unsupported import name_of as _name
from rcg_jax.tasks.actuators import neutral_control
from rcg_jax.tasks.base import Task

#: How far a quaternion's length may be from 1.
_UNIT = 1e-3


class ContractError(ConfigError):
    """A task that cannot be trained. The message is one line that says where, what and which value."""


def refuse(cls: type[Task], what: str, cause: BaseException | None = None) -> NoReturn:
    """Raises the :class:`ContractError` that ``what`` is wrong with a task class."""
    raise ContractError(f"task={cls.spelled()}: {what}") from cause


def one_line(error: BaseException) -> str:
    """An exception's message."""
    return " ".join(str(error).split()) or type(error).__name__


def place(cls: type[Task], error: BaseException) -> str:
    """Which line of the class's file an exception passed through, in brackets; empty if none."""
    source = cls.source()
    line = line_in(error, source)
    return f" ({source.name}, line {line})" if source and line else ""


def check_model(task: Task) -> None:
    """Actuators that actions in [-1, 1] can be scaled to, and no state besides positions and velocities."""
    cls, model = type(task), task.model
    if not model.nu:
        refuse(cls, "has a model without actuators: nothing can be learned")
    if what := hidden_state(model):
        refuse(cls, f"has a model with {what}: only positions and velocities are state here")
    for i in np.flatnonzero(model.actuator_plugin >= 0).tolist():
        if cls.neutral_action is Task.neutral_action:
            who = _name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)
            refuse(cls, f"has a model whose actuator {who} is a plugin: the class has to give its neutral_action")
    for i in range(model.nu):
        who = f"actuator {_name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)}"
        low, high = model.actuator_ctrlrange[i]
        if not model.actuator_ctrllimited[i]:
            refuse(cls, f"has a model whose {who} is not limited: give it a ctrlrange, actions in [-1, 1] scale to it")
        if not (np.isfinite([low, high]).all() and low < high):
            refuse(cls, f"has a model whose {who} has ctrlrange {low:g} {high:g}: must be two rising numbers")


def check_goal_state(task: Task) -> np.ndarray:
    """s^g, (nq,) float, in order."""
    cls, model = type(task), task.model
    joints = ", ".join(_name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(model.njnt))
    try:
        goal = np.asarray(task.goal_state, float)
    except Exception as error:
        refuse(cls, f"goal_state cannot be had{place(cls, error)}: {describe(error)}", error)
    if goal.shape != (model.nq,):
        refuse(cls, f"goal_state has shape {goal.shape}: must be ({model.nq},), nq of its model (joints {joints})")
    if not np.isfinite(goal).all():
        refuse(cls, f"goal_state = {goal.tolist()}: must be finite")
    for i in range(model.njnt):
        kind, start = mujoco.mjtJoint(int(model.jnt_type[i])), int(model.jnt_qposadr[i])
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            start += 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)
            length = np.linalg.norm(goal[start : start + 4])
            if abs(length - 1) > _UNIT:
                who = _name(model, mujoco.mjtObj.mjOBJ_JOINT, i)
                refuse(
                    cls,
                    f"goal_state has a quaternion of length {length:.4g} at [{start}:{start + 4}] (joint {who}): "
                    "must be 1",
                )
    return goal


def overlap(model: mujoco.MjModel, qpos: np.ndarray) -> str:
    """The two geoms that are deepest inside each other at ``qpos`` (nq,), and how deep; empty if none are."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    try:
        with silence():
            mujoco.mj_forward(model, data)
    except mujoco.FatalError:
        return "more contacts than the model has memory for"
    if not data.ncon or data.contact.dist.min() >= 0:
        return ""
    k = int(np.argmin(data.contact.dist))
    pair = " and ".join(f"geom {_name(model, mujoco.mjtObj.mjOBJ_GEOM, int(g))}" for g in data.contact.geom[k])
    return f"{pair} overlap by {-data.contact.dist[k]:.4g} m"


def check_overlap(task: Task, goal: np.ndarray, max_depth: float) -> None:
    """Nothing overlaps at s^g by more than a search lets starts overlap."""
    model, data = task.model, mujoco.MjData(task.model)
    data.qpos[:] = goal
    with suppress(mujoco.FatalError), silence():  # what has no room for its contacts is refused by the step
        mujoco.mj_forward(model, data)
    if data.ncon and -data.contact.dist.min() > max_depth:
        refuse(
            type(task),
            f"goal_state is in penetration: {overlap(model, goal)}; at most {max_depth:g} m is allowed (max_depth of "
            "its search)",
        )


def check_range(task: Task, goal: np.ndarray, max_excess: float) -> None:
    """Joints and tendons at s^g are within their ranges, or beyond by as little as a search lets starts be."""
    model, data = task.model, mujoco.MjData(task.model)
    data.qpos[:] = goal
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    for i in np.flatnonzero(model.tendon_limited).tolist():
        value, (low, high) = data.ten_length[i], model.tendon_range[i]
        if not low - max_excess <= value <= high + max_excess:
            who = f"tendon {_name(model, mujoco.mjtObj.mjOBJ_TENDON, i)}"
            refuse(type(task), f"goal_state has {who} at {value:.6g}: must be in its range, {low:.6g} to {high:.6g}")
    for i in np.flatnonzero((model.jnt_limited != 0) & (model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL))).tolist():
        adr = int(model.jnt_qposadr[i])
        w, *xyz = goal[adr : adr + 4]
        angle, most = 2 * np.arctan2(np.linalg.norm(xyz), abs(w)), model.jnt_range[i].max()
        if angle > most + max_excess:
            who = f"joint {_name(model, mujoco.mjtObj.mjOBJ_JOINT, i)}"
            refuse(type(task), f"goal_state has {who} turned by {angle:.6g}: must be in its range, 0 to {most:.6g}")
    for i in np.flatnonzero(model.jnt_limited).tolist():
        if int(model.jnt_type[i]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
            continue
        value, (low, high) = goal[model.jnt_qposadr[i]], model.jnt_range[i]
        if not low - max_excess <= value <= high + max_excess:
            who = f"joint {_name(model, mujoco.mjtObj.mjOBJ_JOINT, i)}"
            refuse(type(task), f"goal_state has {who} at {value:.6g}: must be in its range, {low:.6g} to {high:.6g}")


def check_one_step(task: Task, goal: np.ndarray) -> None:
    """C MuJoCo's step from the goal state, at rest, under the neutral control; nothing to compile."""
    model, data = task.model, mujoco.MjData(task.model)
    data.qpos[:] = goal
    data.ctrl[:] = neutral_ctrl(task, goal)
    try:
        with silence():
            mujoco.mj_step(model, data)
    except mujoco.FatalError as error:
        refuse(type(task), f"goal_state does not survive one step: {one_line(error)}", error)
    fine = all((np.abs(x) < mujoco.mjMAXVAL).all() for x in (data.qpos, data.qvel, data.qacc))
    if not fine:
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


def _step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """One step; NaN where MuJoCo cannot."""
    try:
        mujoco.mj_step(model, data)
    except mujoco.FatalError:
        data.qpos[:], data.qvel[:] = np.nan, np.nan


def roll_out(
    model: mujoco.MjModel, qpos: np.ndarray, steps: int, ctrl: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """C MuJoCo from rest at ``qpos`` (nq,): positions (steps, nq) and velocities (steps, nv).

    Args:
        model: the model.
        qpos: where it begins.
        steps: how many.
        ctrl: (nu,) held all the time; by default the control that is neutral at ``qpos``.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    if ctrl is None:
        offset, slope = neutral_control(model, qpos)
        ctrl = np.clip(offset + slope @ qpos, *model.actuator_ctrlrange.T)
    data.ctrl[:] = ctrl
    states = []
    with silence():
        for _ in range(steps):
            _step(model, data)
            states.append((data.qpos.copy(), data.qvel.copy()))
    positions, velocities = zip(*states, strict=True)
    return np.array(positions), np.array(velocities)


def random_states(task: Task, qpos: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (num, nq) and velocities (num, nv) that random actions lead to from rest at ``qpos``, in C MuJoCo."""
    model, rng = task.model, np.random.default_rng(0)
    low, high = model.actuator_ctrlrange.T
    data, states = mujoco.MjData(model), []
    for step in range(num):
        if step % 32 == 0 or not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = qpos
        data.ctrl[:] = rng.uniform(low, high)
        with silence():
            _step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
    positions, velocities = zip(*states, strict=True)
    return np.array(positions), np.array(velocities)
