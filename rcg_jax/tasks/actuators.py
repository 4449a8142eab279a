"""What a model's actuators mean to a task: the range that actions scale to, and the control that moves nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

#: A keyframe is that of a state where no position differs by more [rad, m].
_SAME = 1e-3


def _affine(model: mujoco.MjModel, i: int) -> bool:
    """Whether the force of actuator ``i`` is linear in its control, its length and its velocity, with a constant."""
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
    if mujoco.mjtTrn(int(model.actuator_trntype[i])) not in (
        mujoco.mjtTrn.mjTRN_JOINT,
        mujoco.mjtTrn.mjTRN_JOINTINPARENT,
    ):
        return None
    joint = int(model.actuator_trnid[i, 0])
    kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
    return joint if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE) else None


def give_ranges(model: mujoco.MjModel) -> None:
    """Gives actuators without a ``ctrlrange`` the one that their model implies; others are left as they are.

    A position servo follows its control, so it takes the range of its joint, times the gear. A motor with a
    ``forcerange`` takes the controls that reach it.
    """
    for i in np.flatnonzero(~model.actuator_ctrllimited.astype(bool)).tolist():
        joint, gain = _one_joint(model, i), model.actuator_gainprm[i, 0]
        if _servo(model, i) and joint is not None and model.jnt_limited[joint]:
            ends = model.jnt_range[joint] * model.actuator_gear[i, 0] * (-model.actuator_biasprm[i, 1] / gain)
        elif (
            model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
            and model.actuator_forcelimited[i]
            and gain
        ):
            ends = model.actuator_forcerange[i] / gain
        else:
            continue
        model.actuator_ctrlrange[i] = np.sort(ends)
        model.actuator_ctrllimited[i] = 1


def neutral_control(model: mujoco.MjModel, goal_state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The control with which the actuators leave a state at rest alone, ``offset + slope @ qpos``.

    A motor exerts no force at 0. A servo exerts none where its control is where it already is, so a position servo's
    control follows its joint. Where the model has a keyframe of the goal state with a control of its own, that control
    is the neutral one there, whatever it compensates; elsewhere it is shifted by as much. An actuator that pulls on
    something other than hinges, slides and fixed tendons has no such line (:func:`neutral_action` asks MuJoCo for its
    length); one whose force is no linear function of its control keeps its control of the goal state.

    Args:
        model: its ranges are those of :func:`give_ranges`.
        goal_state: s^g, (nq,).

    Returns:
        offset (nu,) and slope (nu, nq), before clipping to the actuators' range.
    """
    length = _lengths(model, np.asarray(goal_state, float)[None])[0]
    offset, slope = np.zeros(model.nu), np.zeros((model.nu, model.nq))
    for i in range(model.nu):
        if not _affine(model, i):
            continue
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
        slope[i] = _length_slope(model, i) * -bias[1] / gain
        offset[i] = -(bias[0] + bias[1] * length[i]) / gain - slope[i] @ goal_state
    for k in range(model.nkey):
        if (
            _same_pose(model, model.key_qpos[k], goal_state) and model.key_ctrl[k].any()
        ):  # MuJoCo gives a keyframe without controls zeros
            offset += model.key_ctrl[k] - (offset + slope @ goal_state)
            break
    return offset, slope


def _same_pose(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two positions are one pose, wherever a free body is: quaternions count up to their sign and length."""
    for joint in range(model.njnt):
        kind, adr = mujoco.mjtJoint(int(model.jnt_type[joint])), int(model.jnt_qposadr[joint])
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            adr += 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)
            one, other = (q[adr : adr + 4] / max(float(np.linalg.norm(q[adr : adr + 4])), 1e-9) for q in (a, b))
            different = min(np.abs(one - other).max(), np.abs(one + other).max()) > _SAME
        else:
            different = abs(a[adr] - b[adr]) > _SAME
        if different:
            return False
    return True


def _length_slope(model: mujoco.MjModel, i: int) -> np.ndarray:
    """How the length of actuator ``i`` changes with qpos, (nq,), where that is linear; otherwise zeros."""
    slope = np.zeros(model.nq)
    joint = _one_joint(model, i)
    if joint is not None:
        slope[model.jnt_qposadr[joint]] = model.actuator_gear[i, 0]
    elif model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
        tendon = int(model.actuator_trnid[i, 0])
        begin = int(model.tendon_adr[tendon])
        wraps = range(begin, begin + int(model.tendon_num[tendon]))
        if all(model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
            for w in wraps:
                slope[model.jnt_qposadr[model.wrap_objid[w]]] += model.wrap_prm[w] * model.actuator_gear[i, 0]
    return slope


def scaled(model: mujoco.MjModel, ctrl: Any) -> Any:
    """Controls (..., nu), of NumPy or JAX, as actions in [-1, 1]."""
    low, high = model.actuator_ctrlrange.T
    return (ctrl - low) / (high - low) * 2 - 1


def neutral_action(model: mujoco.MjModel, goal_state: np.ndarray) -> Callable[[Array], Array]:
    """A function (B, nq) -> (B, nu): the actions in [-1, 1] that leave states at rest alone (:func:`neutral_control`).

    Lengths of servos that pull on spatial tendons, sites or ball joints are MuJoCo's own, on the host.
    """
    offset, slope = neutral_control(model, goal_state)
    low, high = model.actuator_ctrlrange.T
    offset, slope = scaled(model, offset), slope * (2 / (high - low))[:, None]
    bent = np.array([_servo(model, i) and not _length_slope(model, i).any() for i in range(model.nu)])
    if not slope.any() and not bent.any():
        constant = np.clip(offset, -1, 1).astype(np.float32)
        return lambda qpos: jnp.broadcast_to(constant, (*qpos.shape[:-1], model.nu))
    at_goal = _lengths(model, goal_state[None])[0]
    per_length = np.where(bent, -model.actuator_biasprm[:, 1] / model.actuator_gainprm[:, 0] * 2 / (high - low), 0.0)
    offset, slope = offset.astype(np.float32), slope.astype(np.float32)

    def stretched(qpos: np.ndarray) -> np.ndarray:
        flat = np.asarray(qpos, float).reshape(-1, model.nq)
        change = (_lengths(model, flat) - at_goal) * per_length
        return change.reshape(*qpos.shape[:-1], model.nu).astype(np.float32)

    def action(qpos: Array) -> Array:
        linear = offset + jnp.einsum("un,...n->...u", slope, qpos, precision="highest")
        if bent.any():
            like = jax.ShapeDtypeStruct((*qpos.shape[:-1], model.nu), jnp.float32)
            linear += jax.pure_callback(stretched, like, jax.lax.stop_gradient(qpos), vmap_method="expand_dims")
        return jnp.clip(linear, -1, 1)

    return action


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
