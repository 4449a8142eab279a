"""Activations of actuators are state: C MuJoCo's steps, and they go wherever positions go."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import ReverseCurriculum, feasible, sample_nearby, task_from_mujoco
from rcg_jax.config.compose import compose_config
from rcg_jax.config.search import FeasibleConfig
from rcg_jax.curriculum.feasible import from_rows, search, to_rows
from rcg_jax.curriculum.replay import append, init_replay
from rcg_jax.curriculum.sample_nearby import brownian_walks
from rcg_jax.curriculum.settle import settle
from rcg_jax.gymnasium import make, make_vec
from rcg_jax.io.starts_file import StartsFileError, encode_starts, hash_starts, load_states
from rcg_jax.physics import make_engine
from rcg_jax.physics.engine import UnsupportedModelError, reset
from rcg_jax.runs import checkpoint
from rcg_jax.tasks import make_task
from rcg_jax.tasks.check import ContractError, check_task
from rcg_jax.train_step import init_train_state, make_train_step
from rcg_jax.types import StartSet
from tests.activation_models import KINDS, MOTOR, SEVERAL, arm, c_mujoco, model_of
from tests.engine_runs import stepper

CORRELATED = 5  # steps under the same controls
SMALL = (
    *("curriculum.num_new=8", "curriculum.num_old=4", "curriculum.num_candidates=40", "curriculum.brownian_horizon=5"),
    *("curriculum.replay_capacity=20", "rollout.num_envs=8", "rollout.batch_size=400", "policy.hidden=[8]"),
    *("baseline.hidden=[8]", "baseline.minibatch_size=100"),
)


def some_states(model: mujoco.MjModel, batch: int = 3, steps: int = 20) -> tuple[list[np.ndarray], np.ndarray]:
    """Positions and activations of states at rest, and controls (T, B, nu) that push for a while."""
    rng = np.random.default_rng(0)
    start = [rng.uniform(-0.5, 0.5, (batch, model.nq)), rng.uniform(0, 0.4, (batch, model.na))]
    controls = rng.uniform(*model.actuator_ctrlrange.T, (-(-steps // CORRELATED), batch, model.nu))
    return [x.astype(np.float32) for x in start], controls.repeat(CORRELATED, axis=0).astype(np.float32)


def simulated(engine: Any, start: list[np.ndarray], controls: np.ndarray) -> list[np.ndarray]:
    qpos, act = map(jnp.asarray, start)
    state, rows = reset(qpos, jnp.zeros((len(qpos), engine.model.nv)), act), []
    for ctrl in controls:
        state = stepper(engine)(state, jnp.asarray(ctrl))
        assert not state.bad.any()
        rows.append(jax.device_get((state.qpos, state.qvel, state.act)))
    return [np.stack([row[k] for row in rows]) for k in range(3)]


class TestEngines:
    @pytest.mark.parametrize("kind", [*KINDS, "several"])
    def test_native_is_c_mujoco(self, kind: str) -> None:
        model = model_of(KINDS.get(kind, SEVERAL))
        start, controls = some_states(model)
        for found, expected in zip(
            simulated(make_engine("native", model), start, controls), c_mujoco(model, start, controls), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=2e-5)

    @pytest.mark.parametrize("integrator", ["Euler", pytest.param("RK4", marks=pytest.mark.slow), "implicitfast"])
    def test_mjx_is_c_mujoco(self, integrator: str) -> None:
        """All kinds in one model: one compilation."""
        left = [] if integrator != "implicitfast" else ["muscle"]
        model = model_of("".join(text for kind, text in KINDS.items() if kind not in left) + MOTOR)
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        start, controls = some_states(model)
        for found, expected in zip(
            simulated(make_engine("mjx", model), start, controls), c_mujoco(model, start, controls), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=2e-4)

    @pytest.mark.slow
    @pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="warp-lang is not installed")
    def test_warp_is_c_mujoco(self) -> None:
        user = '<general joint="a" dyntype="user" actdim="2" ctrlrange="-1 1"/>'
        model = model_of("".join(KINDS.values()) + MOTOR + user)
        start, controls = some_states(model)
        for found, expected in zip(
            simulated(make_engine("warp", model), start, controls), c_mujoco(model, start, controls), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=2e-5)

    @pytest.mark.parametrize(
        ("actuator", "what"),
        [
            ('<general joint="a" dyntype="user" actdim="2" ctrlrange="-1 1"/>', "mjDYN_USER"),
            ('<dcmotor joint="a" motorconst="1 1" resistance="1" inductance=".1" ctrlrange="-1 1"/>', "actearly"),
            (KINDS["filter"].replace("/>", ' actearly="true"/>'), "actearly"),
        ],
    )
    def test_what_mjx_lacks_is_refused_and_native_has_it(self, actuator: str, what: str) -> None:
        model = model_of(actuator + MOTOR)
        with pytest.raises(UnsupportedModelError, match=rf"MJX .*{what}.*engine=native can"):
            make_engine("mjx", model)
        start, controls = some_states(model)
        for found, expected in zip(
            simulated(make_engine("native", model), start, controls), c_mujoco(model, start, controls), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=2e-5)

    def test_muscles_of_mjx_are_no_implicit_ones(self) -> None:
        model = model_of(KINDS["muscle"] + MOTOR)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        with pytest.raises(UnsupportedModelError, match=r"implicitfast steps of the muscle \(Euler and RK4 can\)"):
            make_engine("mjx", model)

    def test_an_activation_that_is_lost_makes_a_simulation_bad(self) -> None:
        model = model_of(KINDS["filter"] + MOTOR)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # as of tasks
        start = reset(jnp.zeros((2, 2)), jnp.zeros((2, 2)), jnp.array([[0.2], [jnp.nan]]))
        after = make_engine("native", model).step(start, jnp.ones((2, 2)))
        assert after.bad.tolist() == [False, True]
        assert after.act is not None
        assert float(after.act[0, 0]) > 0.2

    def test_held_actions_and_seeds_side_by_side(self) -> None:
        task = arm()
        state, action = task.reset(task.goal_starts()), jnp.full((1, 4), 0.7)
        one_by_one = state
        for _ in range(3):
            one_by_one = task.step(one_by_one, action)
        last = jax.tree.map(lambda x: x[:, -1], task.steps(state, action, 3))
        jax.tree.map(np.testing.assert_array_equal, last, one_by_one)
        seeds = jax.vmap(task.step, (None, 0))(state, jnp.stack([action, -action]))
        jax.tree.map(np.testing.assert_array_equal, jax.tree.map(lambda x: x[0], seeds), task.step(state, action))

    def test_a_plugin_does_not_look_at_the_time(self) -> None:
        """The PID plugin takes no heed of its last control, a part of its activation, at time 0 alone."""
        plugin = '<config key="kp" value="4"/><config key="ki" value="20"/><config key="slewmax" value="1"/>'
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><extension><plugin plugin="mujoco.pid"><instance name="pid">{plugin}</instance></plugin>
            </extension><worldbody><body><joint name="x" type="slide" damping="1"/><geom size=".1"/></body></worldbody>
            <actuator><plugin joint="x" plugin="mujoco.pid" instance="pid" actdim="2" ctrlrange="-1 1"/></actuator>
            </mujoco>"""
        )
        engine, start = make_engine("native", model), [np.zeros((1, 1)), np.full((1, 2), 0.1)]
        controls = np.full((20, 1, 1), 0.5)
        first, again = (simulated(engine, start, controls) for _ in range(2))
        data = mujoco.MjData(model)
        data.time, data.act[:], data.ctrl[:] = 1.0, 0.1, 0.5
        mujoco.mj_step(model, data, 20)
        for path, other, expected in zip(first, again, (data.qpos, data.qvel, data.act), strict=True):
            np.testing.assert_array_equal(path, other)
            np.testing.assert_allclose(path[-1, 0], expected, atol=1e-5)


class TestStarts:
    def test_models_without_have_no_leaf_for_it(self) -> None:
        task = make_task("point_maze", "native")
        starts = task.goal_starts()
        state = task.reset(starts)
        assert task.with_act(starts) is starts
        assert (starts.act, state.act, task.snapshot(state).act) == (None, None, None)
        assert [len(jax.tree.leaves(x)) for x in (starts, state, task.snapshot(state))] == [3, 4, 6]
        names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]]
        assert names == [".qpos", ".qvel", ".qacc_warmstart", ".bad"]

    def test_neutral_activations_exert_no_force(self) -> None:
        servo = '<intvelocity tendon="t" kp="30" ctrlrange="-1 1" actrange="0 2"/>'
        actuators = KINDS["integrator"] + KINDS["filterexact"] + servo + KINDS["filter"]
        task = arm(actuators=actuators)
        check_task(task, starts=False)
        starts = task.at_rest(jnp.array([[0.4, -0.3], [0.1, 0.3], [0.0, 0.2]]))
        assert starts.act is not None
        np.testing.assert_allclose(starts.act[:, :2], starts.qpos, atol=1e-6)
        stays, drift = settle(task, starts, 50)
        assert stays.all()
        assert float(drift.max()) < 1e-4
        # ... where integrators are left alone and others have the control that they follow.
        np.testing.assert_allclose(task.neutral_action(starts.qpos)[:, [0, 2]], 0.0, atol=1e-6)

    def test_a_keyframe_of_the_goal_state_says_which(self) -> None:
        key = '<keyframe><key qpos=".4 -.3" act=".1 .2 .3" ctrl="0 0 .5 .25"/></keyframe>'
        task = arm(rest=key)
        np.testing.assert_allclose(task.goal_starts().act, [[0.1, 0.2, 0.3]], atol=1e-6)
        np.testing.assert_allclose(task.at_rest(jnp.array([[0.5, -0.2]])).act, [[0.2, 0.3, 0.3]], atol=1e-6)
        followed = arm(rest=key.replace('act=".1 .2 .3"', ""))
        np.testing.assert_allclose(followed.goal_starts().act, [[0.4, 0.5, 0.25]], atol=1e-6)

    def test_walks_keep_the_activations_of_the_states_they_visit(self) -> None:
        """A state that a walk visited, with its activation, goes on as C MuJoCo does from the same."""
        task = arm()
        start = task.at_rest(jnp.array([[0.1, 0.2]]), jnp.array([[0.3, -0.1, 0.6]]))
        walks = brownian_walks(
            task, jax.random.key(0), start, num_walks=4, num_snapshots=6, walk_length=6, noise_std=0.3, noise="white"
        )
        assert walks.valid.all()
        assert walks.act is not None
        assert np.ptp(walks.act, axis=0).min() > 0.01
        model = task.model
        visited = [np.asarray(walks.qpos), np.asarray(walks.act)]
        _, controls = some_states(model, batch=24)
        found, expected = simulated(task.engine, visited, controls), c_mujoco(model, visited, controls)
        np.testing.assert_allclose(found[0], expected[0], atol=2e-5)
        zeros = c_mujoco(model, [visited[0], 0 * visited[1]], controls)
        assert np.abs(zeros[0] - expected[0]).max() > 0.01  # it matters

    def test_sample_nearby_and_replay(self) -> None:
        task = arm(settle_steps=2)
        alone = StartSet.at_rest(jnp.array([[0.4, -0.3]]), 2)  # without activations: the neutral ones
        found = sample_nearby(task, jax.random.key(0), alone, num_new=8, num_candidates=40, brownian_horizon=5)
        assert found.act is not None
        assert found.act.shape == (8, 3)
        replay = append(jax.random.key(1), init_replay(task.goal_starts(), 10), found)
        np.testing.assert_array_equal(replay.act[1:9], found.act)

    def test_files_keep_them(self, tmp_path: Path) -> None:
        rng, file = np.random.default_rng(0), tmp_path / "starts.npz"
        qpos, act = (rng.uniform(-0.1, 0.1, (5, n)).astype(np.float32) + [0.4] * n for n in (2, 3))
        qpos, act = qpos.astype(np.float32), act.astype(np.float32)
        file.write_bytes(encode_starts(qpos, act))
        for found, expected in zip(load_states(file), (qpos, act), strict=True):
            np.testing.assert_array_equal(found, expected)
        task = arm(feasible_file=file)
        np.testing.assert_array_equal(task.feasible_starts().act, act)
        assert task.starts_sha256() != hash_starts(qpos)
        file.write_bytes(encode_starts(qpos))
        assert encode_starts(qpos) == encode_starts(qpos, np.zeros((5, 0)))
        with pytest.raises(StartsFileError, match="0 activations per start, Variant has 3"):
            task.feasible_starts()
        np.savez(file, qpos=qpos, act=act + 1, sha256=np.array(hash_starts(qpos)))
        with pytest.raises(StartsFileError, match="does not match its hash"):
            task.feasible_starts()

    def test_a_search_finds_starts_that_go_on_as_they_were_found(self) -> None:
        task = arm()
        rounds = search(
            task, seed=0, num_walks=8, walk_length=10, noise_std=0.3, noise="integrated", grid=0.02,
            max_depth=0.01, max_excess=0.1, max_drift=0.1, settle_steps=2,
        )  # fmt: skip
        next(rounds)
        rows = next(rounds).rows
        starts = from_rows(task, jnp.asarray(rows))
        assert starts.act is not None
        assert np.ptp(starts.act, axis=0).min() > 0.01
        np.testing.assert_array_equal(to_rows(starts), rows)
        config = FeasibleConfig(task="arm", num_states=5, num_found=5, num_walks=8, walk_length=10, grid=0.02)
        result = feasible.generate(task, config, lambda line: None)
        assert result.act is not None
        assert result.act.shape == (5, 3)
        assert feasible.describe(task, result.qpos, result.act)["count"] == 5

    def test_an_exact_sampler_has_to_give_them(self) -> None:
        at = jnp.tile(jnp.array([0.4, -0.3]), (1000, 1))
        good = arm(sample_feasible=lambda self, key, num: self.at_rest(at[:num]))
        check_task(good)
        bad = arm(sample_feasible=lambda self, key, num: StartSet.at_rest(at[:num], 2))
        with pytest.raises(ContractError, match=r"returns act of .*: must be of shape \(257, 3\)"):
            check_task(bad)


class TestTraining:
    def task(self) -> Any:
        at = jnp.array([0.4, -0.3])
        return arm(
            sample_feasible=lambda self, key, num: self.at_rest(at + 0.3 * jax.random.normal(key, (num, 2))),
            training={"policy.action_repeat": 2},
        )

    @pytest.mark.slow
    @pytest.mark.parametrize("method", ["reverse", "self_play"])
    def test_a_few_iterations_and_a_checkpoint(self, method: str, tmp_path: Path) -> None:
        task, config = self.task(), compose_config([*SMALL, f"method={method}"])
        step = jax.jit(make_train_step(config, task))
        state = init_train_state(config, task, 0)
        for _ in range(2):
            state, metrics = step(state)
        assert np.isfinite(float(metrics.success))
        assert state.starts.act.shape[1] == 3
        assert np.ptp(np.asarray(state.starts.act)) > 0
        checkpoint.save([tmp_path], 2, [state])
        again = checkpoint.restore([tmp_path], state)
        assert again is not None
        jax.tree.map(np.testing.assert_array_equal, *(step(one)[0].starts for one in (state, again.states[0])))

    @pytest.mark.slow
    def test_the_curriculum_as_an_object_and_gymnasium(self) -> None:
        task = self.task()
        curriculum = ReverseCurriculum(task, settings=[word for word in SMALL if word.startswith("curriculum.")])
        starts = curriculum.propose(6)
        assert starts.act is not None
        env = make_vec(task, 6, starts=task.goal_starts())
        obs, _ = env.reset(options={"qpos": starts.qpos, "qvel": starts.qvel, "act": starts.act})
        np.testing.assert_allclose(obs, np.hstack([starts.qpos, starts.qvel, starts.act]))
        obs, _ = env.reset(options={"qpos": starts.qpos})
        np.testing.assert_allclose(obs[:, 4:], task.neutral_act(jnp.asarray(starts.qpos)), atol=1e-6)
        env.reset(options={"qpos": np.tile([-0.2, 0.4], (6, 1)), "act": np.full((6, 3), 0.1)})
        obs, *_ = env.step(np.ones((6, 4)))
        assert (obs[:, 4:] > 0.1).all()
        with pytest.raises(ValueError, match="act: needs qpos, too"):
            env.reset(options={"act": starts.act})
        with pytest.raises(ValueError, match=r"act: must have the shape \(6, 3\)"):
            env.reset(options={"qpos": starts.qpos, "act": starts.act[:, :2]})
        one = make(task, starts=task.goal_starts())
        assert one.reset(options={"qpos": starts.qpos[0], "act": starts.act[0]})[0].shape == (7,)

    def test_a_task_from_a_model_observes_them(self) -> None:
        key = '<keyframe><key name="goal" qpos=".4 -.3" act=".1 .2 .3"/></keyframe>'
        task = task_from_mujoco(model_of(rest=key), point="tip")("native")
        check_task(task, starts=False)
        parts = {part.name: part.size for part in task.observation_parts()}
        assert parts == {"positions": 2, "velocities": 2, "activations": 3, "mid": 3, "tip": 3}
        np.testing.assert_allclose(task.observe_batch(task.reset(task.goal_starts()))[0, 4:7], [0.1, 0.2, 0.3])


def test_brax_begins_with_them() -> None:
    brax = pytest.importorskip("rcg_jax.brax")
    task = arm()
    starts = task.at_rest(jnp.array([[0.1, 0.2]]), jnp.array([[0.3, -0.1, 0.6]]))
    env = brax.TaskEnv(task, starts=starts)
    state = env.reset(jax.random.key(0))
    np.testing.assert_allclose(state.obs[4:], [0.3, -0.1, 0.6])
    assert env.step(state, jnp.ones(4)).pipeline_state.act.shape == (3,)
