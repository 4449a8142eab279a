"""Joint limits and contacts as rows of a quadratic penalty, with the batch as the last axis.

A frictionless contact is one row along its normal; one with sliding friction (condim 3, pyramidal cone) has a row for
each of the four edges of its friction pyramid. A row e says that J_e qacc should not be below its reference
acceleration, with weight D_e; MuJoCo's documentation ("Computation", solver parameters) has the formulas. Rows that do
not act have weight zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.physics.contact_solver.collide import COLLIDERS, Geoms
from rcg_jax.physics.unsupported import narrow_joints

_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)


class Rows(NamedTuple):
    """E one-sided constraints of B environments."""

    jacobian: Array  # (E, V, B), V = nv
    weight: Array  # (E, B), the inverse regularisation D; 0 where the row does not act
    reference: Array  # (E, B), the reference acceleration


class Frames(NamedTuple):
    """What rows are made of, named as in MuJoCo, the batch last."""

    qpos: Array  # (nq, B)
    qvel: Array  # (V, B)
    geom_xpos: Array  # (ngeom, 3, B)
    geom_xmat: Array  # (ngeom, 3, 3, B)
    cdof: Array  # (V, 6, B), motion axes of the joints about subtree_com of their tree
    subtree_com: Array  # (nbody, 3, B)


def supported(model: mujoco.MjModel) -> bool:
    """Whether :func:`make_rows` covers every constraint that ``model`` can have."""
    return bool(
        all(_types(model, p) in COLLIDERS and (model.pair_dim[p] == 1 or _slides(model, p)) for p in range(model.npair))
        and not (model.geom_contype.any() or model.geom_conaffinity.any())
        and model.neq == model.ntendon == model.nflex == 0
        and not model.dof_frictionloss.any()
        and np.isin(model.jnt_type, _JOINTS).all()
        and (model.pair_solref > 0).all()
        and (model.jnt_solref > 0).all()
    )


def make_rows(model: mujoco.MjModel) -> Callable[[Frames], Rows]:
    """Returns the function that builds all rows of ``model``: its joint limits, then its contact pairs."""
    parts: list[_Part] = []
    flags, disable = model.opt.disableflags, mujoco.mjtDisableBit
    if not flags & (disable.mjDSBL_LIMIT | disable.mjDSBL_CONSTRAINT) and model.jnt_limited.any():
        parts.append(_limits(model))
    if not flags & (disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT):
        groups: dict[tuple[tuple[int, int], int], list[int]] = {}
        for pair in range(model.npair):
            groups.setdefault((_types(model, pair), int(model.pair_dim[pair])), []).append(pair)
        parts += [_contacts(model, types, pairs) for (types, _), pairs in groups.items()]

    def rows(frames: Frames) -> Rows:
        if not parts:
            nv, num = frames.qvel.shape
            return Rows(jnp.zeros((0, nv, num)), jnp.zeros((0, num)), jnp.zeros((0, num)))
        made = [part(frames) for part in parts]
        penalties = [_penalty(model, soft, pos, jnp.sum(j * frames.qvel, axis=1)) for j, pos, soft in made]
        weights, references = zip(*penalties, strict=True)
        return Rows(jnp.concatenate([j for j, _, _ in made]), jnp.concatenate(weights), jnp.concatenate(references))

    return rows


class _Softness(NamedTuple):
    """Constants of E rows: solref (E, 2), solimp (E, 5), and the inverse inertia that the row feels (E,)."""

    solref: np.ndarray
    solimp: np.ndarray
    invweight: np.ndarray


#: A function that gives the Jacobian (E, V, B) and the distances (E, B) of some rows, and their constants.
_Part = Callable[[Frames], tuple[Array, Array, _Softness]]


def _penalty(model: mujoco.MjModel, soft: _Softness, pos: Array, rate: Array) -> tuple[Array, Array]:
    """Weight and reference (E, B) of rows at distance ``pos`` [m or rad] (negative: acting) that change at ``rate``."""
    time, ratio = soft.solref.T
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        time = np.maximum(time, 2 * model.opt.timestep)
    low, high = np.clip(soft.solimp[:, :2].T, mujoco.mjMINIMP, mujoco.mjMAXIMP)
    width = np.maximum(soft.solimp[:, 2], mujoco.mjMINVAL)
    mid = np.clip(soft.solimp[:, 3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    power = np.maximum(soft.solimp[:, 4], 1.0)
    stiffness, damping = 1 / (high * time * ratio) ** 2, 2 / (high * time)

    def column(x: np.ndarray) -> Array:
        return jnp.asarray(x[:, None], jnp.float32)

    depth = jnp.clip(jnp.abs(pos) / column(width), 0.0, 1.0)

    def raised(x: Array) -> Array:
        return x * x if (power == 2).all() else x ** column(power)

    rising = raised(depth) * column(mid ** (1 - power))
    settling = 1 - raised(1 - depth) * column((1 - mid) ** (1 - power))
    impedance = column(low) + column(high - low) * jnp.where(depth < column(mid), rising, settling)
    softness = jnp.maximum(column(soft.invweight) * (1 - impedance) / impedance, mujoco.mjMINVAL)
    weight = jnp.where(pos < 0, 1 / softness, 0.0)
    return weight, -column(damping) * rate - column(stiffness) * impedance * pos


def _limits(model: mujoco.MjModel) -> _Part:
    """Rows of the limited joints: the nearer end of the range, then the other where both can act at once."""
    limited, narrow = np.flatnonzero(model.jnt_limited), narrow_joints(model)
    joints = np.concatenate([limited, narrow])
    dofs, adr = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
    soft = _Softness(model.jnt_solref[joints], model.jnt_solimp[joints], model.dof_invweight0[dofs])
    low, high = (jnp.asarray(x[:, None], jnp.float32) for x in model.jnt_range[joints].T)
    margin = jnp.asarray(model.jnt_margin[joints][:, None], jnp.float32)
    place = jnp.asarray(np.eye(model.nv)[dofs][:, :, None], jnp.float32)
    nearer = jnp.asarray((np.arange(len(joints)) < len(limited))[:, None])

    def rows(f: Frames) -> tuple[Array, Array, _Softness]:
        below, above = f.qpos[adr] - low, high - f.qpos[adr]
        lower = (below < above) == nearer
        return place * jnp.where(lower, 1.0, -1.0)[:, None], jnp.where(lower, below, above) - margin, soft

    return rows


def _types(model: mujoco.MjModel, pair: int) -> tuple[int, int]:
    """Geom types of a pair, the lower first."""
    a, b = sorted(int(model.geom_type[g[pair]]) for g in (model.pair_geom1, model.pair_geom2))
    return a, b


def _slides(model: mujoco.MjModel, pair: int) -> bool:
    """Whether a pair has sliding friction of a kind that is covered."""
    pyramids = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    # There C MuJoCo takes the pyramid's directions from the normal alone.
    sphere = int(mujoco.mjtGeom.mjGEOM_SPHERE) in _types(model, pair)
    return bool(pyramids and sphere and model.pair_dim[pair] == 3)


def _tangents(normal: Array) -> tuple[Array, Array]:
    """Two directions across ``normal`` (3, ...), those of C MuJoCo."""
    x, y, z = normal
    steep = jnp.abs(y) >= 0.5  # else the first is the y axis, made perpendicular
    along = jnp.where(steep, z, y)
    first = jnp.stack([-along * x, jnp.where(steep, 0.0, 1.0) - along * y, jnp.where(steep, 1.0, 0.0) - along * z])
    first = first / jnp.sqrt(jnp.sum(first * first, axis=0))
    return first, _cross(normal, first)


def _cross(a: Array, b: Array) -> Array:
    """Vector product on the first axis."""
    return jnp.stack([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


def _contacts(model: mujoco.MjModel, types: tuple[int, int], pairs: list[int]) -> _Part:
    """Rows of pairs of the same two geom types, all with or all without friction; ordered (edge, point, pair)."""
    collider, points = COLLIDERS[types]
    geoms = np.stack([model.pair_geom1[pairs], model.pair_geom2[pairs]])
    order = np.argsort(model.geom_type[geoms], axis=0, kind="stable")  # the lower type first
    sides = [_Side(model, g) for g in np.take_along_axis(geoms, order, axis=0)]
    invweight = sum(model.body_invweight0[s.body, 0] for s in sides)
    # Edges of the friction pyramid: the normal plus or minus friction times a tangent.
    edges: list[tuple[int, np.ndarray]] = []
    if model.pair_dim[pairs[0]] == 3:
        friction = model.pair_friction[pairs, :2].T
        edges = [(k, sign * friction[k]) for k in range(2) for sign in (1, -1)]
        invweight = invweight * (1 + friction[0] ** 2) * 2 * friction[0] ** 2 / model.opt.impratio
    copies = points * max(len(edges), 1)
    solref, solimp = (np.tile(x[pairs], (copies, 1)) for x in (model.pair_solref, model.pair_solimp))
    soft = _Softness(solref, solimp, np.tile(invweight, copies))
    # The gap is no part of it: it only makes C MuJoCo list contacts early, before they act.
    margin = jnp.asarray(model.pair_margin[pairs][:, None], jnp.float32)

    def rows(f: Frames) -> tuple[Array, Array, _Softness]:
        found = collider(sides[0].geoms(f), sides[1].geoms(f))

        def along(direction: Array) -> Array:
            return sides[1].along(f, found.pos, direction) - sides[0].along(f, found.pos, direction)

        jacobian = along(found.normal)[None]
        if edges:
            across = [along(tangent) for tangent in _tangents(found.normal)]
            jacobian = jnp.stack(
                [jacobian[0] + jnp.asarray(mu[:, None, None], jnp.float32) * across[k] for k, mu in edges]
            )
        num = found.dist.shape[-1]
        # An infinite distance (no such contact) must not reach the arithmetic of the row.
        pos = jnp.tile(jnp.minimum(found.dist - margin, 1.0).reshape(-1, num), (max(len(edges), 1), 1))
        # Rows that do not act get a zero Jacobian, too: their geometry may be meaningless.
        jacobian = jnp.where(pos[:, None] < 0, jacobian.reshape(-1, *jacobian.shape[3:]), 0.0)
        return jacobian, pos, soft

    return rows


class _Side:
    """One geom of each of P pairs."""

    def __init__(self, model: mujoco.MjModel, geoms: np.ndarray) -> None:
        self.index = geoms
        self.size = model.geom_size[geoms]
        self.body = model.geom_bodyid[geoms]
        self._root = model.body_rootid[self.body]
        self._moves = np.stack([_ancestors(model, b) for b in self.body])

    def geoms(self, f: Frames) -> Geoms:
        pos = jnp.stack([f.geom_xpos[g] for g in self.index], axis=1)
        mat = jnp.stack([f.geom_xmat[g] for g in self.index], axis=2)
        return Geoms(pos, mat, self.size)

    def along(self, f: Frames, point: Array, direction: Array) -> Array:
        """How fast ``point`` (3, K, P, B) on the bodies moves along ``direction`` per joint, (K, P, V, B)."""
        if not self._moves.any():
            return jnp.zeros(())
        com = jnp.stack([f.subtree_com[r] for r in self._root], axis=1)
        offset = point - com[:, None]
        wrench = jnp.concatenate([_cross(offset, direction), direction])
        speed = sum(wrench[k][:, :, None] * f.cdof[:, k] for k in range(6))
        return speed * jnp.asarray(self._moves[:, :, None], jnp.float32)  # type: ignore[no-any-return]


def _ancestors(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Which joints move ``body``, (nv,) bool."""
    chain = []
    while body:
        chain.append(body)
        body = model.body_parentid[body]
    return np.isin(model.dof_bodyid, chain)


def frames(qpos: Array, qvel: Array, data: Any) -> Frames:
    """:class:`Frames` of a batch of ``mjx.Data`` after ``mjx.com_pos``."""
    last = [jnp.moveaxis(x, 0, -1) for x in (data.geom_xpos, data.geom_xmat, data.cdof, data.subtree_com)]
    return Frames(qpos.T, qvel.T, *jax.lax.optimization_barrier(last))
