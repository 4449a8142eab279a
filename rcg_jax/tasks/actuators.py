"""What a model's actuators mean to a task: the range that actions scale to, and what moves nothing.

An actuator may have an activation between its control and its force: one that follows the control (filters, muscles) or
that the control changes (integrators). At rest it is the one that exerts no force.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.tasks.keyframes import same_pose

_DYN = mujoco.mjtDyn

#: Activations that come to their control, if it stays.
_FOLLOWS = tuple(int(kind) for kind in (_DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT, _DYN.mjDYN_MUSCLE))


def _integrates(model: mujoco.MjModel) -> np.ndarray:
    """(nu,) bool, actuators whose control is the rate of their activation."""
    return np.asarray(model.actuator_dyntype == int(_DYN.mjDYN_INTEGRATOR))


def _affine(model: mujoco.MjModel, i: int) -> bool:
    """Whether the force of actuator ``i`` is linear in its control, its length and its velocity, with a constant.

    For "control" read "activation" where it has one that the force follows.
    """
    return bool(
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_gainprm[i, 0] != 0
    )


def _servo(model: mujoco.MjModel, i: int) -> bool:
    """Whether actuator ``i`` pulls its length towards its control: force = kp (ctrl - length) + ..."""
    return _affine(model, i) and bool(model.actuator_biasprm[i, 1] != 0)


def _one_joint(model: mujoco.MjModel, i: int) -> int | None:
    """The hinge or slide that actuator ``i`` acts on; None where it acts on something else."""
    joint = int(model.actuator_trnid[i, 0])
    on_joint = int(model.actuator_trntype[i]) in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return joint if on_joint and int(model.jnt_type[joint]) in scalar else None


def give_ranges(model: mujoco.MjModel) -> None:
    """Gives actuators without a ``ctrlrange`` the one that their model implies; others are left as they are.

    A position servo follows its control, so it takes the range of its joint, times the gear. A motor with a
    ``forcerange`` takes the controls that reach it. A muscle's control is between 0 and 1.
    """
    if model.nu != model.nactuator:  # such a task is refused
        return
    for i in np.flatnonzero((model.actuator_ctrllimited == 0) & ~_integrates(model)).tolist():
        joint, gain = _one_joint(model, i), model.actuator_gainprm[i, 0]
        motor = (
            model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        )
        if _servo(model, i) and joint is not None and model.jnt_limited[joint]:
            ends = model.jnt_range[joint] * model.actuator_gear[i, 0] * (-model.actuator_biasprm[i, 1] / gain)
        elif motor and model.actuator_forcelimited[i] and gain:
            ends = model.actuator_forcerange[i] / gain
        elif model.actuator_dyntype[i] == _DYN.mjDYN_MUSCLE:
            ends = np.array([0.0, 1.0])
        else:
            continue
        model.actuator_ctrlrange[i] = np.sort(ends)
        model.actuator_ctrllimited[i] = 1


def neutral_control(model: mujoco.MjModel, goal_state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The control, before clipping, that leaves a state at rest alone: offset (nu,) and slope (nu, nq) of qpos.

    A motor exerts no force at 0, a servo where its control is where it already is: a position servo's control follows
    its joint. Where the model has a keyframe of the goal state (nq,) with a control of its own, that is the neutral one
    there, whatever it compensates; elsewhere it is shifted by as much. An actuator that pulls on something other than
    hinges, slides and fixed tendons has no such line (:func:`neutral_action` asks MuJoCo for its length); one whose
    force is no linear function of its control keeps its control of the goal state. The control of an activation that
    integrates is 0.
    """
    offset, slope = _no_force(model, goal_state)
    offset[_integrates(model)], slope[_integrates(model)] = 0.0, 0.0
    for qpos, ctrl in zip(model.key_qpos, model.key_ctrl, strict=True):
        # Without controls MuJoCo gives a keyframe zeros.
        if ctrl.any() and same_pose(model, qpos, goal_state, anywhere=True):
            return offset + (ctrl - (offset + slope @ goal_state)), slope
    return offset, slope


def _neutral_activation(model: mujoco.MjModel, goal_state: np.ndarray) -> tuple[np.ndarray, ...]:
    """The activations of states at rest: offset (na,), slope (na, nq), and per length of the actuator (na,).

    Those that follow a control are what :func:`neutral_control` leads to, those that integrate one exert no force; any
    others are 0. Where the model has a keyframe of the goal state with activations of its own, they are shifted to it.
    """
    offset, slope, bent = np.zeros(model.na), np.zeros((model.na, model.nq)), np.zeros(model.na)
    control, force = neutral_control(model, goal_state), _no_force(model, goal_state)
    for i in np.flatnonzero(model.actuator_actnum).tolist():
        k, kind = model.actuator_actadr[i] + model.actuator_actnum[i] - 1, int(model.actuator_dyntype[i])
        if model.actuator_plugin[i] < 0 and kind in (*_FOLLOWS, int(_DYN.mjDYN_INTEGRATOR)):
            offset[k], slope[k] = (line[i] for line in (control if kind in _FOLLOWS else force))
            bent[k] = _per_length(model)[i]
    for qpos, act in zip(model.key_qpos, model.key_act, strict=True):
        if act.any() and same_pose(model, qpos, goal_state, anywhere=True):
            offset += act - (offset + slope @ goal_state)
            break
    return offset, slope, bent


def _no_force(model: mujoco.MjModel, goal_state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset (nu,) and slope (nu, nq) of the control, or of an activation that stands for it, that exerts no force."""
    length = _lengths(model, np.asarray(goal_state, float)[None])[0]
    offset, slope = np.zeros(model.nu), np.zeros((model.nu, model.nq))
    for i in range(model.nu):
        if _affine(model, i):
            gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
            slope[i] = _length_slope(model, i) * -bias[1] / gain
            offset[i] = -(bias[0] + bias[1] * length[i]) / gain - slope[i] @ goal_state
    return offset, slope


def _per_length(model: mujoco.MjModel) -> np.ndarray:
    """(nu,): of servos whose length is no linear function of qpos, what their control changes by with it; else 0."""
    change = np.zeros(model.nu)
    for i in range(model.nu):
        if _servo(model, i) and not _length_slope(model, i).any():
            change[i] = -model.actuator_biasprm[i, 1] / model.actuator_gainprm[i, 0]
    return change


def _length_slope(model: mujoco.MjModel, i: int) -> np.ndarray:
    """How the length of actuator ``i`` changes with qpos, (nq,), where that is linear; otherwise zeros."""
    slope, gear = np.zeros(model.nq), model.actuator_gear[i, 0]
    joint = _one_joint(model, i)
    if joint is not None:
        slope[model.jnt_qposadr[joint]] = gear
    elif model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
        tendon = model.actuator_trnid[i, 0]
        wraps = model.tendon_adr[tendon] + np.arange(model.tendon_num[tendon])
        if (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all():
            for w in wraps:
                slope[model.jnt_qposadr[model.wrap_objid[w]]] += model.wrap_prm[w] * gear
    return slope


def neutral_action(model: mujoco.MjModel, goal_state: np.ndarray) -> Callable[[Array], Array]:
    """A function (B, nq) -> (B, nu): the actions in [-1, 1] that leave states at rest alone (:func:`neutral_control`).

    Lengths of servos that pull on spatial tendons, sites or ball joints are MuJoCo's own, on the host.
    """
    offset, slope = neutral_control(model, goal_state)
    low, high = model.actuator_ctrlrange.T
    offset, slope = (offset - low) / (high - low) * 2 - 1, slope * (2 / (high - low))[:, None]
    per_length = np.where(_integrates(model), 0.0, _per_length(model) * 2 / (high - low))
    return _line(model, goal_state, offset, slope, of_length=(np.arange(model.nu), per_length), limits=(-1.0, 1.0))


def neutral_act(model: mujoco.MjModel, goal_state: np.ndarray) -> Callable[[Array], Array]:
    """A function (B, nq) -> (B, na): the activations of states at rest that nothing is known of but their positions.

    Under them and :func:`neutral_action` a servo stays where it is. Within the actuators' ranges.
    """
    offset, slope, per_length = _neutral_activation(model, goal_state)
    owner = np.repeat(np.arange(model.nu), model.actuator_actnum)
    low, high = np.where(model.actuator_actlimited[:, None], model.actuator_actrange, [-np.inf, np.inf])[owner].T
    follows = np.isin(model.actuator_dyntype, _FOLLOWS)[owner]
    least, most = model.actuator_ctrlrange[owner].T
    low, high = np.where(follows, np.maximum(low, least), low), np.where(follows, np.minimum(high, most), high)
    return _line(model, goal_state, offset, slope, of_length=(owner, per_length), limits=(low, high))


def _line(
    model: mujoco.MjModel,
    goal_state: np.ndarray,
    offset: np.ndarray,
    slope: np.ndarray,
    *,
    of_length: tuple[np.ndarray, np.ndarray],
    limits: tuple[Any, Any],
) -> Callable[[Array], Array]:
    """A function (B, nq) -> (B, k): offset (k,) and slope (k, nq), and so much of an actuator's length; within limits.

    Args:
        model, goal_state: where the lengths are what the offset says.
        offset, slope: of a linear function.
        of_length: (k,) actuators, and how each changes with its length since the goal state (k,).
        limits: lowest and highest values.
    """
    owner, per_length = of_length
    low, high = (np.asarray(limit, np.float32) for limit in limits)
    if not slope.any() and not per_length.any():
        constant = np.clip(offset, *limits).astype(np.float32)
        return lambda qpos: jnp.broadcast_to(constant, (*qpos.shape[:-1], len(constant)))
    at_goal = _lengths(model, goal_state[None])[0]
    offset, slope = offset.astype(np.float32), slope.astype(np.float32)

    def stretched(qpos: np.ndarray) -> np.ndarray:
        flat = np.asarray(qpos, float).reshape(-1, model.nq)
        change = (_lengths(model, flat) - at_goal)[:, owner] * per_length
        return change.reshape(*qpos.shape[:-1], len(owner)).astype(np.float32)

    def line(qpos: Array) -> Array:
        linear = offset + jnp.einsum("un,...n->...u", slope, qpos, precision="highest")
        if per_length.any():
            like = jax.ShapeDtypeStruct((*qpos.shape[:-1], len(owner)), jnp.float32)
            linear += jax.pure_callback(stretched, like, jax.lax.stop_gradient(qpos), vmap_method="expand_dims")
        return jnp.clip(linear, low, high)

    return line


def _lengths(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Lengths (B, nu) of the actuators at positions (B, nq)."""
    data, lengths = mujoco.MjData(model), np.zeros((len(qpos), model.nu))
    for row, position in enumerate(qpos):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        lengths[row] = data.actuator_length
    return lengths
