"""Forward kinematics of a batch of states, shared by all engines.

After a step the engines' derived quantities belong to the state before integration, so tasks get theirs from here.
Written out number by number, each an array over the batch: general kinematics with quaternions cost as much as half a
native physics step, and stacking a frame's numbers before their last use makes XLA start a kernel for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.types import Snapshot

#: One number per simulation, (B,), or the same for all; three of them; three rows of a rotation matrix, and an origin.
Number = Array | float
Vector = tuple[Number, Number, Number]
Frame = tuple[tuple[Vector, Vector, Vector], Vector]

#: XLA computes what lies between two barriers again for each of its users, which doubles with every joint: enough
#: joints to make one kernel of, few enough that this does not matter.
_JOINTS_BETWEEN_BARRIERS = 3

_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def make_kinematics(model: mujoco.MjModel) -> Callable[[Array, Array], Snapshot]:
    """Returns a function (qpos (B, nq), qvel (B, nv)) -> Snapshot with leading axis B."""
    moving = np.flatnonzero((model.body_weldid != 0) & (model.body_mocapid[model.body_weldid] < 0)).tolist()
    mass = model.body_mass[moving] / max(float(model.body_mass[moving].sum()), mujoco.mjMINVAL)

    def kinematics(qpos: Array, qvel: Array) -> Snapshot:
        num = qpos.shape[0]
        q = [qpos[:, k] for k in range(model.nq)]
        frames: list[Frame] = [(_IDENTITY, (0.0, 0.0, 0.0))]
        since = [0]  # joints between each body and the last barrier towards the root
        for body in range(1, model.nbody):
            parent = model.body_parentid[body]
            origin = _point(frames[parent], model.body_pos[body])
            frame: Frame = _turn(frames[parent][0], _matrix(model.body_quat[body])), origin
            first = model.body_jntadr[body]
            for joint in range(first, first + model.body_jntnum[body]):
                frame = _move(model, joint, frame, q)
            count = since[parent] + int(model.body_jntnum[body])
            if count >= _JOINTS_BETWEEN_BARRIERS:
                frame, count = jax.lax.optimization_barrier(_arrays(frame, num)), 0
            frames.append(frame)
            since.append(count)
        sites = [_point(frames[b], p) for b, p in zip(model.site_bodyid, model.site_pos)]
        centres = [_point(frames[b], model.body_ipos[b]) for b in moving]
        com = tuple(sum((m * c[k] for m, c in zip(mass.tolist(), centres)), 0.0) for k in range(3))
        return Snapshot(
            qpos=qpos,
            qvel=qvel,
            xpos=_stack([p for _, p in frames], num),
            xmat=_stack([r for r, _ in frames], num),
            site_xpos=_stack(sites, num) if sites else jnp.zeros((num, 0, 3)),
            com=_stack(com, num),
        )

    return kinematics


def quaternions(model: mujoco.MjModel) -> dict[int, slice]:
    """Where the positions (nq,) of a model hold quaternions: free and ball joints by number."""
    kinds = mujoco.mjtJoint
    found = {}
    for joint in np.flatnonzero(np.isin(model.jnt_type, (kinds.mjJNT_FREE, kinds.mjJNT_BALL))).tolist():
        first = int(model.jnt_qposadr[joint]) + 3 * int(model.jnt_type[joint] == kinds.mjJNT_FREE)
        found[joint] = slice(first, first + 4)
    return found


def _arrays(tree: Any, num: int) -> Any:
    """Numbers as arrays (B,)."""
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (num,)), tree)


def _stack(nested: Any, num: int) -> Array:
    """Nested sequences of numbers as one array with leading axis B."""
    if isinstance(nested, (list, tuple)):
        return jnp.stack([_stack(x, num) for x in nested], axis=1)
    return _arrays(nested, num)


def _dot(row: Sequence[Number], vector: Sequence[float] | np.ndarray) -> Number:
    """Sum of products with constants, skipping zeros."""
    return sum((x * float(v) for x, v in zip(row, vector) if v != 0), 0.0)


def _point(frame: Frame, pos: np.ndarray) -> Any:
    """Where a constant point of ``frame`` is, three numbers."""
    return tuple(o + _dot(row, pos) for o, row in zip(frame[1], frame[0]))


def _turn(rotation: Any, matrix: np.ndarray) -> Any:
    """A rotation times a constant matrix (3, 3)."""
    if np.array_equal(matrix, np.eye(3)):
        return rotation
    return tuple(tuple(_dot(row, matrix[:, k]) for k in range(3)) for row in rotation)


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a constant quaternion, exact for the identity."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def _move(model: mujoco.MjModel, joint: int, frame: Frame, q: Sequence[Array]) -> Frame:
    """``frame`` after one joint; q are the positions, nq arrays (B,)."""
    rotation, origin = frame
    address, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
    axis, anchor = model.jnt_axis[joint], model.jnt_pos[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return _quaternion(q[address + 3 : address + 7]), (q[address], q[address + 1], q[address + 2])
    offset = q[address] - float(model.qpos0[address])
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        moved: Any = tuple(o + _dot(row, axis) * offset for o, row in zip(origin, rotation))
        return rotation, moved
    fixed = _point(frame, anchor)  # rotations turn about the anchor, which stays where it is
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        turn = _quaternion(q[address : address + 4])
        turned: Any = tuple(
            tuple(sum((row[m] * turn[m][k] for m in range(3)), 0.0) for k in range(3)) for row in rotation
        )
    else:
        turned = _hinge(rotation, axis, offset)
    return turned, _point((turned, fixed), -anchor)


def _hinge(rotation: Any, axis: np.ndarray, angle: Array) -> Any:
    """A rotation turned by angle (B,) about a constant unit axis (3,) of its own frame."""
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) != 1.0:  # oblique: turn the axis onto z and back
        quat = np.zeros(4)
        mujoco.mju_quatZ2Vec(quat, axis)
        onto_z = _matrix(quat)
        return _turn(_hinge(_turn(rotation, onto_z), np.array([0.0, 0.0, 1.0]), angle), onto_z.T)
    # Each is used by several numbers of the frame, and costs more than all of them.
    c, s = jax.lax.optimization_barrier((jnp.cos(angle), jnp.sin(angle) * float(axis[k])))
    i, j = (k + 1) % 3, (k + 2) % 3
    rows = [list(row) for row in rotation]
    for row in rows:
        row[i], row[j] = c * row[i] + s * row[j], c * row[j] - s * row[i]
    return tuple(map(tuple, rows))


def _quaternion(quat: Sequence[Array]) -> Any:
    """Rotation of quaternions, four arrays (B,), of any non-zero length."""
    w, x, y, z = quat
    scale = jax.lax.rsqrt(jnp.maximum(w * w + x * x + y * y + z * z, 1e-20))
    w, x, y, z = jax.lax.optimization_barrier((w * scale, x * scale, y * scale, z * scale))
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
