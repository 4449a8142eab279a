"""Contacts and the constraint solver of engine=mjx, against C MuJoCo and against plain linear algebra."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.physics import jit as compile
from rcg_jax.physics.contact_solver import constraints, newton
from rcg_jax.physics.contact_solver.collide import COLLIDERS, Geoms
from rcg_jax.tasks import Task


class TestContacts:
    #: A pose of the second geom: how far it may be from the first [m].
    PAIRS = (
        ("plane", "1 1 1", "sphere", "0.02", 0.03),
        ("plane", "1 1 1", "capsule", "0.02 0.16", 0.1),
        ("plane", "1 1 1", "box", "0.05 0.15 0.025", 0.1),
        ("sphere", "0.03", "sphere", "0.02", 0.05),
        ("sphere", "0.03", "capsule", "0.02 0.1", 0.1),
        ("sphere", "0.03", "box", "0.05 0.1 0.025", 0.1),
        ("capsule", "0.03 0.1", "capsule", "0.02 0.16", 0.12),
        ("capsule", "0.028 0.0985", "box", "0.0585 0.15 0.025", 0.15),
        ("capsule", "0.028 0.0985", "box", "0.033 0.0585 0.025", 0.12),
    )

    @pytest.mark.parametrize(("type1", "size1", "type2", "size2", "reach"), PAIRS)
    def test_points_and_normals_equal_c_mujoco(
        self, type1: str, size1: str, type2: str, size2: str, reach: float
    ) -> None:
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody>
            <body mocap="true"><geom name="a" type="{type1}" size="{size1}" contype="0" conaffinity="0"/></body>
            <body><freejoint/><geom name="b" type="{type2}" size="{size2}" contype="0" conaffinity="0"/></body>
            </worldbody><contact><pair geom1="a" geom2="b" margin="0.002" condim="1"/></contact></mujoco>"""
        )
        data = mujoco.MjData(model)
        rng = np.random.default_rng(0)
        num, expected, poses = 1500, [], []
        for i in range(num):
            quat = rng.standard_normal(4)
            if i % 3 == 0:  # nearly parallel, where contacts come in pairs
                quat = np.array([1, *(0.05 * rng.standard_normal(3))])
            data.qpos[:] = [*rng.uniform(-reach, reach, 3), *(quat / np.linalg.norm(quat))]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            expected.append(sorted((c.dist, *c.pos, *c.frame[:3]) for c in data.contact[: data.ncon]))
            poses.append((data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()))

        collider, points = COLLIDERS[int(model.geom_type[0]), int(model.geom_type[1])]
        pos, mat = (np.stack(x, -1).astype(np.float32) for x in zip(*poses))
        sizes = model.geom_size

        @compile.jit
        def collide(pos: jax.Array, mat: jax.Array) -> tuple[jax.Array, ...]:
            first, second = (Geoms(pos[k][:, None], mat[k][:, :, None], sizes[k : k + 1]) for k in range(2))
            return tuple(collider(first, second))

        dist, pos, normal = jax.device_get(collide(pos, mat))
        assert dist.shape == (points, 1, num)
        wrong, touching = 0, 0
        for i in range(num):
            got = sorted(
                (dist[k, 0, i], *pos[:, k, 0, i], *normal[:, k, 0, i]) for k in range(points) if dist[k, 0, i] < 0.002
            )
            touching += bool(expected[i])
            # Which of two equally deep points comes first is a matter of rounding.
            same = len(got) == len(expected[i]) and (
                not got or min(np.abs(np.array(g) - expected[i]).max() for g in (got, got[::-1])) < 2e-4
            )
            wrong += not same
        assert touching > 100
        # On the border between two choices of points float32 may fall on the other side.
        assert wrong <= 0.003 * num

    def test_only_what_rows_can_express_is_taken_from_mjx(self, ring_peg_native: Task) -> None:
        assert constraints.supported(ring_peg_native.model)
        for change in ("friction", "equality", "ball"):
            spec = mujoco.MjSpec.from_file(str(ring_peg_native.xml))
            if change == "friction":
                spec.pairs[0].condim = 3
            elif change == "equality":
                spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="wrist_flex", objtype=mujoco.mjtObj.mjOBJ_JOINT)
            else:
                spec.worldbody.add_body(pos=[0, 0, 5]).add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
                spec.bodies[-1].add_geom(size=[0.1, 0, 0])
            assert not constraints.supported(spec.compile()), change


class TestNewton:
    def test_finds_the_minimum_of_the_cost(self) -> None:
        """At the solution M (a - free) equals the constraint forces, none of which pulls."""
        rng = np.random.default_rng(1)
        nv, num, rows = 5, 64, 12
        root = rng.standard_normal((nv, nv + 3, num))
        mass = np.einsum("ikb,jkb->ijb", root, root) + np.eye(nv)[:, :, None]
        jacobian, weight = rng.standard_normal((rows, nv, num)), rng.uniform(0, 50, (rows, num))
        reference, free = rng.standard_normal((rows, num)), rng.standard_normal((nv, num))
        arrays = [jnp.asarray(x, jnp.float32) for x in (mass, jacobian, weight, reference, free)]
        found = compile.jit(
            lambda m, j, w, r, f: tuple(
                newton.solve(m, constraints.Rows(j, w, r), f, 0 * f, iterations=20, ls_iterations=20, tolerance=1e-8)
            )
        )(*arrays)
        qacc, qfrc = (np.asarray(x, float) for x in found)
        force = weight * np.maximum(reference - np.einsum("evb,vb->eb", jacobian, qacc), 0)
        np.testing.assert_allclose(qfrc, np.einsum("evb,eb->vb", jacobian, force), rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(np.einsum("ijb,jb->ib", mass, qacc - free), qfrc, rtol=1e-3, atol=1e-2)
