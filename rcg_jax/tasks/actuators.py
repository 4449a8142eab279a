"""What a model's actuators mean to a task: the range that actions scale to, and the control that moves nothing."""

from __future__ import annotations

from collections.abc import Callable

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
    joint = int(model.actuator_trnid[i, 0])
    on_joint = int(model.actuator_trntype[i]) in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return joint if on_joint and int(model.jnt_type[joint]) in scalar else None


def give_ranges(model: mujoco.MjModel) -> None:
    """Gives actuators without a ``ctrlrange`` the one that their model implies; others are left as they are.

    A position servo follows its control, so it takes the range of its joint, times the gear. A motor with a
    ``forcerange`` takes the controls that reach it.
    """
    for i in np.flatnonzero(model.actuator_ctrllimited == 0).tolist():
        joint, gain = _one_joint(model, i), model.actuator_gainprm[i, 0]
        motor = (
            model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        )
        if _servo(model, i) and joint is not None and model.jnt_limited[joint]:
            ends = model.jnt_range[joint] * model.actuator_gear[i, 0] * (-model.actuator_biasprm[i, 1] / gain)
        elif motor and model.actuator_forcelimited[i] and gain:
            ends = model.actuator_forcerange[i] / gain
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
    force is no linear function of its control keeps its control of the goal state.
    """
    length = _lengths(model, np.asarray(goal_state, float)[None])[0]
    offset, slope = np.zeros(model.nu), np.zeros((model.nu, model.nq))
    for i in range(model.nu):
        if _affine(model, i):
            gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
            slope[i] = _length_slope(model, i) * -bias[1] / gain
            offset[i] = -(bias[0] + bias[1] * length[i]) / gain - slope[i] @ goal_state
    for qpos, ctrl in zip(model.key_qpos, model.key_ctrl, strict=True):
        if ctrl.any() and _same_pose(model, qpos, goal_state):  # without controls MuJoCo gives a keyframe zeros
            return offset + (ctrl - (offset + slope @ goal_state)), slope
    return offset, slope


def _same_pose(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two positions are one pose, wherever a free body is."""
    change = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, a, b)
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        change[model.jnt_dofadr[joint] :][:3] = 0
    return bool(np.abs(change).max() <= _SAME)


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
