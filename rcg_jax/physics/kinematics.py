"""Forward kinematics of a batch of states, shared by all engines.

After ``mjx.step`` and after ``Batch.step`` derived quantities belong to the state before integration, so tasks get
theirs from here, at the state itself. Written out joint by joint with the batch as the last axis, because this runs
once per environment step: general kinematics with quaternions cost as much as half a native physics step.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.base import Snapshot

#: A frame: rotation (3, 3, B), origin (3, B).
Frame = tuple[Array, Array]


def make_kinematics(model: mujoco.MjModel) -> Callable[[Array, Array], Snapshot]:
    """Returns a function (qpos (B, nq), qvel (B, nv)) -> Snapshot with leading axis B."""
    moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    mass = model.body_mass[moving] / max(float(model.body_mass[moving].sum()), mujoco.mjMINVAL)

    def kinematics(qpos: Array, qvel: Array) -> Snapshot:
        q = qpos.T
        num = qpos.shape[0]
        world = jnp.broadcast_to(jnp.eye(3)[:, :, None], (3, 3, num)), jnp.zeros((3, num))
        frames = [world]
        for body in range(1, model.nbody):
            frame = _offset(frames[model.body_parentid[body]], model.body_pos[body], model.body_quat[body])
            first = model.body_jntadr[body]
            for joint in range(first, first + model.body_jntnum[body]):
                frame = _move(model, joint, frame, q)
            # Without the barrier XLA recomputes the whole chain for each of its links' users.
            frames.append(jax.lax.optimization_barrier(frame) if model.body_jntnum[body] else frame)
        sites = [_offset(frames[b], p, None)[1] for b, p in zip(model.site_bodyid, model.site_pos)]
        com = sum(
            (m * _offset(frames[b], model.body_ipos[b], None)[1] for m, b in zip(mass, moving)), jnp.zeros((3, num))
        )
        return Snapshot(
            qpos=qpos,
            qvel=qvel,
            xpos=jnp.stack([p for _, p in frames]).transpose(2, 0, 1),
            xmat=jnp.stack([r for r, _ in frames]).transpose(3, 0, 1, 2),
            site_xpos=jnp.stack(sites).transpose(2, 0, 1) if sites else jnp.zeros((num, 0, 3)),
            com=com.T,
        )

    return kinematics


def _offset(frame: Frame, pos: np.ndarray, quat: np.ndarray | None) -> Frame:
    """``frame`` moved by a constant offset in its own axes; zero and identity cost nothing."""
    rotation, origin = frame
    if np.any(pos != 0):
        origin = origin + _times(rotation, pos)
    if quat is not None:
        rotation = _turn(rotation, _matrix(quat))
    return rotation, origin


def _times(rotation: Array, vector: np.ndarray) -> Array:
    """rotation (3, 3, B) times a constant vector (3,), skipping its zeros; (3, B)."""
    return sum((float(x) * rotation[:, k] for k, x in enumerate(vector) if x != 0), jnp.zeros_like(rotation[:, 0]))


def _turn(rotation: Array, matrix: np.ndarray) -> Array:
    """rotation (3, 3, B) times a constant matrix (3, 3)."""
    if np.array_equal(matrix, np.eye(3)):
        return rotation
    return jnp.stack([_times(rotation, matrix[:, k]) for k in range(3)], axis=1)


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a constant quaternion, exact for the identity."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def _move(model: mujoco.MjModel, joint: int, frame: Frame, q: Array) -> Frame:
    """``frame`` after one joint; q is (nq, B)."""
    rotation, origin = frame
    address, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
    axis, anchor = model.jnt_axis[joint], model.jnt_pos[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return _quaternion(q[address + 3 : address + 7]), q[address : address + 3]
    offset = q[address] - model.qpos0[address]
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        return rotation, origin + _times(rotation, axis) * offset
    # Rotations turn about the anchor, which stays where it is.
    fixed = origin + _times(rotation, anchor)
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        turn = _quaternion(q[address : address + 4])
        rotation = jnp.einsum("ijb,jkb->ikb", rotation, turn)
    else:
        rotation = _hinge(rotation, axis, offset)
    return rotation, fixed - _times(rotation, anchor)


def _hinge(rotation: Array, axis: np.ndarray, angle: Array) -> Array:
    """rotation (3, 3, B) turned by angle (B,) about a constant unit axis (3,) of its own frame."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) != 1.0:  # oblique: turn the axis onto z and back
        quat, z = np.zeros(4), np.zeros(4)
        mujoco.mju_quatZ2Vec(z, axis)
        mujoco.mju_negQuat(quat, z)
        return _turn(_hinge(_turn(rotation, _matrix(z)), np.array([0.0, 0.0, 1.0]), angle), _matrix(quat))
    s = s * axis[k]
    i, j = (k + 1) % 3, (k + 2) % 3
    columns = [rotation[:, m] for m in range(3)]
    columns[i], columns[j] = c * columns[i] + s * columns[j], c * columns[j] - s * columns[i]
    return jnp.stack(columns, axis=1)


def _quaternion(quat: Array) -> Array:
    """Rotation matrices (3, 3, B) of quaternions (4, B) of any non-zero length."""
    w, x, y, z = quat / jnp.sqrt(jnp.maximum(jnp.sum(quat * quat, axis=0), 1e-20))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
