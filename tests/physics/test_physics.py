from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.physics import ENGINES, make_engine
from rcg_jax.physics import jit as compile
from rcg_jax.physics.contact_solver import constraints
from rcg_jax.physics.engine import reset
from rcg_jax.physics.kinematics import make_kinematics
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine
from rcg_jax.tasks import Task
from rcg_jax.types import PhysicsState
from tests.engine_runs import (
    BATCH,
    around_the_peg,
    correlated_controls,
    stepper,
    trajectory,
)

#: Every kind of joint, off-centre anchors, an oblique axis, several joints on one body, a body without joints.
JOINTS = """<mujoco><worldbody>
  <body pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 0.2"><joint type="slide" axis="0 0.6 0.8"/>
    <joint type="hinge" axis="1 2 -1" pos="0.1 0 0.05" ref="0.3"/>
    <geom size="0.1" pos="0.05 0 0.1"/>
    <body pos="0.2 0 0"><geom size="0.05"/><site pos="0.1 0.1 0"/>
      <body pos="0 0.3 0" euler="20 30 40"><joint type="ball" pos="0 0.05 0.02"/>
        <geom type="box" size="0.1 0.2 0.3"/><site/>
      </body>
    </body>
  </body>
  <body pos="1 1 1"><freejoint/><geom size="0.1" pos="0.3 0 0"/><site pos="0 0 0.2"/>
    <body pos="0 0 0.3"><joint type="hinge" axis="0 -1 0"/><geom size="0.1 0.1" type="capsule"/></body>
  </body>
</worldbody></mujoco>"""


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.slow if name == "warp" else ()) for name in ENGINES])
def engine(request: pytest.FixtureRequest):
    return request.getfixturevalue(f"ring_peg_{request.param}").engine


def at_rest(qpos: np.ndarray) -> PhysicsState:
    return reset(jnp.asarray(qpos), jnp.zeros(qpos.shape))


def assert_equal(a: PhysicsState, b: PhysicsState) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


class TestKinematics:
    @pytest.mark.parametrize("xml", [None, JOINTS], ids=["ring_peg", "every joint"])
    def test_equals_c_mujoco(self, ring_peg_native: Task, xml: str | None) -> None:
        model = ring_peg_native.model if xml is None else mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        rng = np.random.default_rng(0)
        qpos = rng.uniform(-2, 2, (20, model.nq))
        qvel = rng.standard_normal((20, model.nv))
        got = jax.device_get(compile.jit(make_kinematics(model))(jnp.asarray(qpos), jnp.asarray(qvel)))
        for i in range(20):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            np.testing.assert_allclose(got.xpos[i], data.xpos, atol=2e-6)
            np.testing.assert_allclose(got.xmat[i], data.xmat.reshape(-1, 3, 3), atol=2e-6)
            np.testing.assert_allclose(got.site_xpos[i], data.site_xpos, atol=2e-6)
            np.testing.assert_allclose(got.com[i], data.subtree_com[0], atol=2e-6)
        np.testing.assert_array_equal(got.qvel, qvel.astype(np.float32))


class TestNonFinite:
    @pytest.mark.slow
    @pytest.mark.parametrize("what", ["huge velocity", "nan position", "inf position"])
    def test_one_environment_is_frozen_and_the_others_do_not_notice(
        self, ring_peg_native: Task, engine, what: str
    ) -> None:
        good = at_rest(around_the_peg(ring_peg_native))
        ctrl = jnp.asarray(correlated_controls(1, BATCH, 7, seed=5)[0])
        if what == "huge velocity":
            broken = good.replace(qvel=good.qvel.at[3].set(1e30))
        else:
            broken = good.replace(qpos=good.qpos.at[3, 2].set(jnp.nan if what == "nan position" else jnp.inf))
        step = stepper(engine)
        expected, got = jax.device_get(step(good, ctrl)), jax.device_get(step(broken, ctrl))
        assert got.bad.tolist() == [i == 3 for i in range(BATCH)]
        others = np.arange(BATCH) != 3
        assert_equal(*(jax.tree.map(lambda x: x[others], s) for s in (expected, got)))
        np.testing.assert_array_equal(got.qpos[3], broken.qpos[3])
        np.testing.assert_array_equal(got.qvel[3], broken.qvel[3])
        assert np.isfinite(got.qacc_warmstart).all()


class TestPure:
    def test_same_input_same_output(self, ring_peg_native: Task, engine) -> None:
        state = at_rest(around_the_peg(ring_peg_native))
        controls = jnp.asarray(correlated_controls(3, BATCH, 7, seed=6))
        step = stepper(engine)
        first = step(state, controls[0])
        step(step(first, controls[1]), controls[2])  # whatever happens in between
        assert_equal(step(state, controls[0]), first)

    def test_native_under_vmap_equals_separate_calls(self, ring_peg_native: Task) -> None:
        starts = around_the_peg(ring_peg_native, batch=24)
        states = [at_rest(starts[8 * k : 8 * k + 8]) for k in range(3)]
        controls = jnp.asarray(correlated_controls(3, 8, 7, seed=8))
        together = compile.jit(jax.vmap(ring_peg_native.engine.step))(
            jax.tree.map(lambda *x: jnp.stack(x), *states), controls
        )
        for k, state in enumerate(states):
            separate = stepper(ring_peg_native.engine)(state, controls[k])
            assert_equal(jax.tree.map(lambda x, k=k: x[k], together), separate)

    @pytest.mark.slow
    def test_mjx_under_vmap_equals_separate_calls(self, ring_peg_native: Task, ring_peg_mjx: Task) -> None:
        state = at_rest(around_the_peg(ring_peg_native))
        ctrl = jnp.asarray(correlated_controls(1, BATCH, 7, seed=8)[0])
        split = jax.tree.map(lambda x: x.reshape(2, BATCH // 2, *x.shape[1:]), (state, ctrl))
        together = compile.jit(jax.vmap(ring_peg_mjx.engine.step))(*split)
        separate = stepper(ring_peg_mjx.engine)(state, ctrl)
        for name in ("qpos", "qvel"):
            a = getattr(together, name).reshape(BATCH, 7)
            np.testing.assert_allclose(a, getattr(separate, name), atol=2e-4)


class TestChoosing:
    def test_native_needs_a_cpu(self, ring_peg_native: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        with pytest.raises(RuntimeError, match="engine=native runs on a CPU only; the JAX backend is gpu"):
            make_engine("native", ring_peg_native.model)

    @pytest.mark.slow
    def test_other_models_are_stepped_by_mjx_itself(self) -> None:
        """Dry friction is beyond our constraint rows: mjx.step does it, and agrees with C MuJoCo."""
        model = mujoco.MjModel.from_xml_string(
            """<mujoco><worldbody><body><joint name="j" axis="0 1 0" frictionloss="0.2"/>
            <geom size="0.05" pos="0.3 0 0"/></body></worldbody><actuator><motor joint="j"/></actuator></mujoco>"""
        )
        assert not constraints.supported(model)
        qpos = np.linspace(-1, 1, 4, dtype=np.float32)[:, None]
        controls = np.zeros((5, 4, 1), np.float32)
        native, mjx = (trajectory(e(model), qpos, controls)[0] for e in (NativeEngine, MjxEngine))
        np.testing.assert_allclose(native, mjx, atol=1e-5)


class TestCompile:
    @pytest.mark.parametrize(
        ("precision", "written"), [("float32", "HIGHEST"), ("tensorfloat32", "HIGH"), ("default", "DEFAULT")]
    )
    def test_matrix_products_are_as_precise_as_asked(self, precision: str, written: str) -> None:
        def product(a: jax.Array) -> jax.Array:
            return a @ a

        program = compile.jit(product, matmul_precision=precision).lower(jnp.ones((4, 4)))
        assert f"precision = [{written}, {written}]" in program.as_text()
        if precision == "float32":
            assert compile.jit(product).lower(jnp.ones((4, 4))).as_text() == program.as_text()

    def test_barriers_survive(self) -> None:
        """Else XLA fuses across them, and the constraint solver is three times slower."""

        def f(x: jax.Array) -> jax.Array:
            return jax.lax.optimization_barrier(jnp.sin(x)) * 2

        assert "opt-barrier" in compile.jit(f).lower(jnp.ones(8)).compile().as_text()


#: Boxes that overlap fill its arena with contacts, boxes far from each other do not.
CROWD = (
    '<mujoco><size memory="{memory}"/><option timestep="0.005"/><worldbody><geom type="plane" size="5 5 .1"/>'
    + '<body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>' * 10
    + '<body pos="0 0 3"><joint name="x" type="slide" axis="1 0 0"/><geom size=".05" mass="1"/></body></worldbody>'
    '<actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>'
)


@pytest.mark.parametrize("memory", ["60K", "100K", "300K"])
def test_native_ends_the_simulation_that_mujoco_cannot_go_on_with(memory, tmp_path, monkeypatch, capfd):
    """MuJoCo raises for the second of three, or leaves out contacts; the others are as without it, in silence."""
    monkeypatch.chdir(tmp_path)
    engine = NativeEngine(mujoco.MjModel.from_xml_string(CROWD.format(memory=memory)))
    apart = engine.model.qpos0.copy()
    apart[2:70:7] = 5 * np.arange(1, 11)
    together = engine.model.qpos0 + 0.0
    step = jax.jit(engine.step)
    rows = jnp.asarray(np.stack([apart, together, apart]), jnp.float32)
    moved = step(reset(rows, jnp.zeros((3, engine.model.nv))), jnp.zeros((3, 1)))
    np.testing.assert_array_equal(moved.bad, [False, True, False])
    np.testing.assert_array_equal(moved.qpos[1], rows[1])
    np.testing.assert_allclose(moved.qpos[0, 2], 5 - 9.81 * 0.005**2, rtol=1e-6)
    again = step(reset(rows[:1].repeat(3, 0), jnp.zeros((3, engine.model.nv))), jnp.zeros((3, 1)))
    np.testing.assert_array_equal(again.qpos[1], moved.qpos[0])
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
