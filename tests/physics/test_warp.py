"""engine=warp: what it refuses, everywhere; what it computes, where its packages are installed."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import run
from rcg_jax.config.settings import ConfigError
from rcg_jax.physics import jit as compile
from rcg_jax.physics import make_engine, unsupported, warp
from rcg_jax.physics.engine import Engine, UnsupportedModelError, reset
from rcg_jax.tasks import Task
from tests.engine_runs import anywhere, around_the_peg, contact_counts, correlated_controls, stepper, trajectory
from tests.physics.test_unsupported import slider

needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="warp-lang is not installed")

#: Environments: a CPU steps some hundreds a second.
ENVS = 64


class TestRefusals:
    def test_without_its_packages(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        assert run.main(["engine=warp", f"run_dir='{tmp_path}'"]) == 2
        assert capsys.readouterr().err == (
            "error: engine=warp: needs NVIDIA's warp-lang, which is not installed; pip install 'rcg_jax[warp]', "
            "or choose engine=mjx\n"
        )
        assert not list(tmp_path.iterdir())

    def test_other_accelerators(self, ring_peg_native: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
        monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
        with pytest.raises(ConfigError, match=r"engine=warp: needs an NVIDIA GPU .* the JAX backend is tpu; or choose"):
            make_engine("warp", ring_peg_native.model)

    def test_a_driver_that_is_too_old(self, ring_peg_native: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        fake = SimpleNamespace(
            config=SimpleNamespace(), LOG_WARNING=30, is_cuda_available=lambda: False, __version__="1.18.0"
        )
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
        monkeypatch.setitem(sys.modules, "warp", fake)
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(jax, "devices", lambda platform=None: [])
        with pytest.raises(ConfigError, match=r"engine=warp: warp-lang 1\.18\.0 cannot use this GPU's driver"):
            make_engine("warp", ring_peg_native.model)

    def test_what_it_would_leave_out(self) -> None:
        assert not unsupported.left_out_by_warp(slider())
        assert unsupported.left_out_by_warp(slider("limited='true' range='0 0.01' margin='0.05'")) == (
            "no both limits at once of joint j"
        )
        armature = slider(motor="<motor name='m' joint='j' armature='3'/>")
        assert unsupported.left_out_by_warp(armature) == "no armature of actuator m"
        filtered = slider(motor="<position name='m' joint='j' timeconst='.1'/>")
        assert not unsupported.left_out_by_warp(filtered)
        filtered.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        assert "filterexact of actuator m" in unsupported.left_out_by_warp(filtered)


class TestCapacity:
    def test_is_enough_for_what_c_mujoco_finds(self, ring_peg_native: Task) -> None:
        contacts, rows = warp.capacity(ring_peg_native.model)
        for starts in (around_the_peg, anywhere):
            found = contact_counts(ring_peg_native.model, starts(ring_peg_native))
            assert 1 <= found.max() <= contacts < warp.MOST_CONTACTS
        assert contacts + ring_peg_native.model.nv <= rows < warp.MOST_ROWS


@needs_warp
@pytest.mark.slow
class TestSteps:
    def test_short_trajectories_are_those_of_c_mujoco(self, ring_peg_native: Task, ring_peg_warp: Task) -> None:
        for starts in (around_the_peg, anywhere):
            qpos = starts(ring_peg_native, ENVS)
            controls = correlated_controls(20, ENVS, 7, seed=1)
            native, got = (trajectory(t.engine, qpos, controls) for t in (ring_peg_native, ring_peg_warp))
            assert np.mean(contact_counts(ring_peg_native.model, native[0]) > 0) > 0.1
            positions, velocities = (np.abs(a - b).max((0, 2)) for a, b in zip(native, got))
            assert np.median(positions) < 2e-6
            assert np.sort(positions)[-3] < 2e-5
            assert np.sort(velocities)[-3] < 1e-3

    def test_seeds_side_by_side_equal_separate_calls(self, ring_peg_native: Task, ring_peg_warp: Task) -> None:
        qpos = jnp.asarray(around_the_peg(ring_peg_native, ENVS))
        state = reset(qpos, jnp.zeros_like(qpos))
        ctrl = jnp.asarray(correlated_controls(1, ENVS, 7, seed=8)[0])
        separate = stepper(ring_peg_warp.engine)(state, ctrl)
        split = jax.tree.map(lambda x: x.reshape(2, ENVS // 2, *x.shape[1:]), (state, ctrl))
        together = compile.jit(jax.vmap(ring_peg_warp.engine.step))(*split)
        np.testing.assert_allclose(together.qpos.reshape(ENVS, 7), separate.qpos, atol=1e-6)
        np.testing.assert_allclose(together.qvel.reshape(ENVS, 7), separate.qvel, atol=1e-4)
        shared = compile.jit(jax.vmap(ring_peg_warp.engine.step, (0, None)))(split[0], split[1][0])
        np.testing.assert_allclose(shared.qpos[0], separate.qpos[: ENVS // 2], atol=1e-6)

    def test_within_a_scan(self, ring_peg_native: Task, ring_peg_warp: Task) -> None:
        qpos = jnp.asarray(around_the_peg(ring_peg_native, ENVS))
        state = reset(qpos, jnp.zeros_like(qpos))
        controls = jnp.asarray(correlated_controls(4, ENVS, 7, seed=7))
        step = ring_peg_warp.engine.step
        scanned = compile.jit(lambda s, c: jax.lax.scan(lambda s, u: (step(s, u), None), s, c)[0])(state, controls)
        for ctrl in controls:
            state = stepper(ring_peg_warp.engine)(state, ctrl)
        np.testing.assert_allclose(scanned.qpos, state.qpos, atol=1e-6)

    def test_simulations_that_do_not_fit_are_bad(self, ring_peg_native: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(warp, "MOST_ROWS", 1)
        engine: Engine = make_engine("warp", ring_peg_native.model)
        qpos = around_the_peg(ring_peg_native, ENVS)
        many = contact_counts(ring_peg_native.model, qpos) > 1
        assert many.any()
        state = compile.jit(engine.step)(reset(jnp.asarray(qpos), jnp.zeros(qpos.shape)), jnp.zeros(qpos.shape))
        assert np.asarray(state.bad)[many].all()
        np.testing.assert_array_equal(state.qpos[many], qpos[many])

    def test_models_that_it_lacks_are_refused(self) -> None:
        model = slider(motor="<motor name='m' joint='j' armature='3'/>")
        with pytest.raises(UnsupportedModelError, match=r"MuJoCo Warp cannot simulate this model: no armature of"):
            make_engine("warp", model)
        pgs = mujoco.MjModel.from_xml_string(
            """<mujoco><option solver="PGS"/><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>"""
        )
        with pytest.raises(UnsupportedModelError, match=r"cannot simulate this model: .*PGS.* \(engine=native can\)"):
            make_engine("warp", pgs)
