"""The ant maze against the facts of the original simulation, its physics, and its feasible starts."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from rcg_jax import feasible, sample_nearby
from rcg_jax.curriculum.feasible import make_settle
from rcg_jax.io.assets import DATA
from rcg_jax.io.starts_file import load_states
from rcg_jax.physics.engine import reset
from rcg_jax.tasks import Task, make_task
from rcg_jax.tasks.ant_maze import AntMaze
from rcg_jax.tasks.check import check_task
from rcg_jax.tasks.check_model import roll_out
from rcg_jax.tasks.maze import Maze
from rcg_jax.types import StartSet
from tests.engine_runs import BATCH, correlated_controls, on_the_way, trajectory

#: Cells of the maze, in the order in which they lead away from the goal [m].
WAY = ((0, 4), (2, 4), (4, 4), (4, 2), (4, 0), (2, 0), (0, 0))
GOAL_STATE = (0, 4, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1)
TORQUE = 150


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("ant_maze", "native")


@pytest.fixture(scope="module")
def mjx_task() -> Task:
    return make_task("ant_maze", "mjx")


@pytest.fixture(scope="module")
def shipped() -> np.ndarray:
    return load_states(DATA / "ant_maze.npz")[0]


def in_maze(x: np.ndarray, y: np.ndarray, margin: float) -> np.ndarray:
    """Whether points are inside the maze, ``margin`` [m] away from its walls."""
    room = (np.minimum(x, y) > -1 + margin) & (np.maximum(x, y) < 5 - margin)
    ahead, beside = np.maximum(x - 3, 0), np.maximum(np.abs(y - 2) - 1, 0)
    return room & (np.hypot(ahead, beside) > margin)


def snapshots(task: Task, qpos: np.ndarray):
    qpos = jnp.asarray(qpos, jnp.float32)
    return task.snapshot(reset(qpos, jnp.zeros((len(qpos), task.model.nv))))


class TestModel:
    def test_is_the_ant_of_rllab(self, task: Task) -> None:
        model = task.model
        assert (model.nq, model.nv, model.nu) == (15, 14, 8)
        assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        for k in range(1, 5):
            np.testing.assert_allclose(np.degrees(model.joint(f"hip_{k}").range), [-30, 30])
            ankle = np.degrees(model.joint(f"ankle_{k}").range)
            np.testing.assert_allclose(ankle, [30, 70] if k in (1, 4) else [-70, -30])
            assert model.geom(f"ankle_{k}").size[0] == 0.08
            np.testing.assert_allclose(np.abs(model.geom(f"foot_{k}").pos), [0.4, 0.4, 0])
        np.testing.assert_array_equal(model.dof_armature, [0] * 6 + [1] * 8)
        np.testing.assert_array_equal(model.dof_damping, [0] * 6 + [1] * 8)
        assert model.geom("torso").size[0] == 0.25
        assert 0.85 < model.body_mass.sum() < 0.95
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-TORQUE, TORQUE]] * 8)
        names = [model.joint(j).name for j in model.actuator_trnid[:, 0]]
        assert names == [f"{part}_{k}" for k in (4, 1, 2, 3) for part in ("hip", "ankle")]
        assert model.opt.timestep == 0.02
        np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])
        assert task.horizon == 2000
        assert task.obs_dim == 41

    def test_u_shaped_maze(self, task: Task) -> None:
        assert {tuple(c) for c in task.maze.open_centres} == set(WAY)
        np.testing.assert_array_equal(task.way, WAY)

    def test_feet_stick_to_the_floor_and_slide_along_walls(self, task: Task) -> None:
        model = task.model
        for p in range(model.npair):
            names = {model.geom(g[p]).name for g in (model.pair_geom1, model.pair_geom2)}
            assert model.pair_dim[p] == (3 if "floor" in names else 1)
        np.testing.assert_allclose(model.pair_friction[model.pair_dim == 3, :2], 1)


class TestTask:
    def test_goal_state(self, task: Task) -> None:
        np.testing.assert_array_equal(task.goal_state, GOAL_STATE)
        s = jax.tree.map(lambda x: x[0], snapshots(task, task.goal_state[None]))
        assert task.is_goal(s)
        assert task.is_feasible(s)
        assert not task.is_failure(s)

    def test_goal_is_a_disk_around_the_centre_of_mass(self, task: Task) -> None:
        rng = np.random.default_rng(0)
        qpos = np.tile(task.goal_state, (500, 1))
        qpos[:, :3] += rng.uniform(-0.8, 0.8, (500, 3)) * [1, 1, 0.3]
        qpos[:, 3:7] = rng.standard_normal((500, 4))
        qpos[:, 7:] += rng.uniform(-0.4, 0.4, (500, 8))
        s = snapshots(task, qpos)
        data, com = mujoco.MjData(task.model), []
        for q in qpos:
            data.qpos[:] = q
            mujoco.mj_kinematics(task.model, data)
            mujoco.mj_comPos(task.model, data)
            com.append(data.subtree_com[1].copy())
        distance = np.linalg.norm(np.array(com)[:, :2] - [0, 4], axis=1)
        np.testing.assert_allclose(jax.vmap(task.distance)(s), distance, atol=2e-6)
        clear = np.abs(distance - 0.5) > 1e-5
        np.testing.assert_array_equal(jax.vmap(task.is_goal)(s)[clear], distance[clear] < 0.5)
        assert 50 < (distance < 0.5).sum() < 450

    @pytest.mark.parametrize(("height", "fails"), [(0.299, True), (0.301, False), (0.999, False), (1.001, True)])
    def test_torso_too_low_or_too_high_is_a_failure(self, task: Task, height: float, fails: bool) -> None:
        qpos = np.array(task.goal_state)
        qpos[2] = height
        s = jax.tree.map(lambda x: x[0], snapshots(task, qpos[None]))
        assert bool(task.is_failure(s)) is fails
        assert bool(task.is_feasible(s)) is not fails


class TestOwnMaze:
    """Five cells elsewhere, the goal off the centre of one: no number of the shipped maze fits."""

    class Mine(AntMaze):
        maze = Maze(rows=("#####", "#.#.#", "#...#", "#####"), origin=(5.0, -9.0))
        goal = (11.2, -5.1)

    def test_keeps_the_contract(self) -> None:
        task = self.Mine("native")
        check_task(task, starts=False)  # its goal state lies in its goal set, among others
        np.testing.assert_array_equal(task.goal_state[:2], (11.2, -5.1))
        np.testing.assert_array_equal(task.goal_state[2:], GOAL_STATE[2:])


class TestPhysics:
    def test_stays_upright_under_zero_action(self, task: Task) -> None:
        stays, drift = make_settle(task, 100)(np.asarray(task.goal_state, np.float32)[None])
        assert stays[0]
        assert drift[0] < 0.001

    def test_on_its_back_it_fails(self, task: Task) -> None:
        """Under zero action, from above the floor: the torso comes to lie lower than 0.3 m."""
        qpos = np.array(task.goal_state, np.float32)
        qpos[3:7] = [0, 1, 0, 0]
        assert not make_settle(task, 100)(qpos[None])[0][0]

    @pytest.mark.parametrize("noise", ["uniform", "integrated"])
    def test_stable_under_random_actions(self, task: Task, noise: str) -> None:
        """10^5 steps at full torque, upright or fallen: finite, at speeds that the motors can reach."""
        num = 500
        sims = Batch(task.model, num)
        sims.qpos[:] = task.goal_state
        rng = np.random.default_rng(1)
        action, fastest = np.zeros((num, 8)), 0.0
        for _ in range(200):
            eps = rng.uniform(-1, 1, (num, 8)) if noise == "uniform" else rng.standard_normal((num, 8))
            action = eps if noise == "uniform" else action + eps
            sims.ctrl[:] = TORQUE * np.clip(action, -1, 1)
            sims.step()
            fastest = max(fastest, np.abs(sims.qvel).max())  # NaN would stay
            out = (sims.qpos[:, 2] < 0) | (sims.qpos[:, 2] > 4)
            assert not np.isnan(sims.qpos).any()
            sims.qpos[out], sims.qvel[out], action[out] = task.goal_state, 0, 0
        assert fastest < 60

    @pytest.mark.slow
    def test_stable_under_random_actions_in_mjx(self, task: Task, mjx_task: Task) -> None:
        """The same in our own solver, without a return to the start: 2 x 10^5 steps, none reported as bad.

        As deep as its legs are long a fallen torso may hang below the floor, which only the feet touch.
        """
        noise = np.random.default_rng(1).standard_normal((400, 500, 8))
        controls = TORQUE * np.clip(np.cumsum(noise, axis=0), -1, 1)
        qpos = np.tile(np.float32(task.goal_state), (500, 1))
        positions, velocities = trajectory(mjx_task.engine, qpos, controls.astype(np.float32))
        assert np.abs(velocities).max() < 40
        assert positions[..., 2].min() > -0.9
        assert positions[..., 2].max() < 4

    @pytest.mark.parametrize("speed", [0, 3])
    def test_walls_are_solid(self, task: Task, speed: float) -> None:
        """Ants thrown through the maze, turned at random, legs moving: the torso (0.25 m) stays out of the walls.

        Contacts are as soft as a step of 20 ms makes them: feet sink in for moments, by 5 cm in half of the runs.
        """
        rng = np.random.default_rng(2)
        num = 400
        qpos = np.tile(task.goal_state, (num, 1))
        qpos[:, :2] = np.array(WAY)[rng.integers(7, size=num)] + rng.uniform(-0.2, 0.2, (num, 2))
        yaw, heading = rng.uniform(0, 2 * np.pi, (2, num))
        qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        assert inside(task.model, qpos, speed, heading).all()
        if speed:
            spec = mujoco.MjSpec.from_file(str(task.xml))  # without walls, a third leaves
            assert inside(spec.compile(), qpos, speed, heading).mean() < 0.75


def inside(model: mujoco.MjModel, qpos: np.ndarray, speed: float, heading: np.ndarray) -> np.ndarray:
    """Whether each ant's torso centre stayed 15 cm away from where the walls should be until it fell, (B,)."""
    sims = Batch(model, len(qpos))
    sims.qpos[:] = qpos
    sims.qvel[:, 0], sims.qvel[:, 1] = speed * np.cos(heading), speed * np.sin(heading)
    stayed, alive = np.ones(len(qpos), bool), np.ones(len(qpos), bool)
    for ctrl in correlated_controls(150, len(qpos), 8, seed=3):
        sims.ctrl[:] = TORQUE * ctrl
        sims.step()
        x, y, z = sims.qpos[:, :3].T
        alive &= (z > 0.3) & (z < 1.0)
        stayed &= ~alive | in_maze(x, y, 0.15)
    return stayed


class TestQuaternions:
    @pytest.mark.slow
    def test_quaternions_of_any_length_are_the_same_state(self, task: Task, mjx_task: Task) -> None:
        qpos = on_the_way(task, seed=4)
        longer = qpos.copy()
        longer[:, 3:7] *= 1 + np.linspace(-1e-3, 1e-3, BATCH, dtype=np.float32)[:, None]
        controls = TORQUE * correlated_controls(3, BATCH, 8, seed=5)
        expected = trajectory(task.engine, qpos, controls)[0][-1]
        for t in (task, mjx_task):
            np.testing.assert_allclose(trajectory(t.engine, longer, controls)[0][-1], expected, atol=1e-4)


class TestFeasibleStarts:
    def test_are_inside_the_maze_and_clear_of_walls(self, task: Task, shipped: np.ndarray) -> None:
        assert in_maze(shipped[:, 0], shipped[:, 1], 0.24).all()

    @pytest.mark.slow
    def test_one_round_of_the_search_walks_from_the_starts(self, task: Task, tmp_path) -> None:
        words = ["task=ant_maze", "num_walks=32", "max_rounds=3", f"out={tmp_path / 'a.npz'}"]
        assert feasible.main(words) == 0
        made = json.loads((tmp_path / "a.json").read_text())
        assert made["settings"]["seeds"] == "starts"
        assert 3 < made["count"] == len(load_states(tmp_path / "a.npz")[0])


@pytest.mark.slow
def test_new_starts_stay_upright(task: Task) -> None:
    """In C MuJoCo, each for 100 steps of zero action; among all that the walks visit some would fall."""
    seeds = task.sample_feasible(jax.random.key(1), 60)
    options = {"num_candidates": 2_000, "walk_rounds": 4, "selection": "spread"}
    found = sample_nearby(task, jax.random.key(0), seeds, 40, **options)
    loose = make_task("ant_maze", "native")
    loose.settle_steps = 0
    unchecked = sample_nearby(loose, jax.random.key(0), seeds, 40, **options)

    def fall(starts: StartSet) -> np.ndarray:
        heights = []
        for qpos in np.asarray(starts.qpos):
            qpos_path, _ = roll_out(task.model, qpos, np.zeros((100, task.model.nu)))
            heights.append(qpos_path[:, 2])
        return np.any((np.array(heights) < 0.3) | (np.array(heights) > 1.0), axis=1)

    assert np.all(found.valid)
    assert np.mean(fall(unchecked)) > 0.1
    assert np.mean(fall(found)) <= 0.05  # float32 and float64 disagree where it hangs by a hair
