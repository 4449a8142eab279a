"""point_maze: its numbers, its goal, walls that hold and do not slow down, and equal engines."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.physics.engine import Engine, reset
from rcg_jax.tasks import PointMaze, Task, make_task
from tests.engine_runs import BATCH, stepper

#: The corridor from its far end to the goal.
CORRIDOR = ((0, 0), (4, 0), (4, -4), (-4, -4), (-4, 4), (4, 4))

#: A little more than the fastest that 2 N over the longest straight, 9.7 m, make a ball of 0.4189 kg [m/s].
TOP_SPEED = 9.75


@pytest.fixture(scope="module")
def tasks() -> dict[str, Task]:
    return {name: make_task("point_maze", name) for name in ("native", "mjx")}


@pytest.fixture(scope="module")
def task(tasks: dict[str, Task]) -> Task:
    return tasks["native"]


@pytest.fixture(params=["native", "mjx"])
def engine(tasks: dict[str, Task], request: pytest.FixtureRequest) -> Engine:
    return tasks[request.param].engine


def wall_distance(xy: np.ndarray) -> np.ndarray:
    """From points (..., 2) to the nearest wall [m]; 0 in walls."""
    return np.asarray(jax.vmap(PointMaze.maze.clearance)(jnp.asarray(xy.reshape(-1, 2)))).reshape(xy.shape[:-1])


def box_distance(xy: np.ndarray) -> np.ndarray:
    """From points (..., 2) to the nearest box that walls are built of [m]: more than to the wall itself at notches."""
    low, high = np.array(PointMaze.maze.wall_boxes()).swapaxes(0, 1)
    beyond = np.maximum(np.maximum(low - xy[..., None, :], xy[..., None, :] - high), 0)
    return np.linalg.norm(beyond, axis=-1).min(-1)


def overlap(task: Task, qpos: np.ndarray) -> np.ndarray:
    """How deep (N,) C MuJoCo finds the ball in walls [m]."""
    data, ball = mujoco.MjData(task.model), task.model.geom("ball").id
    depth = np.zeros(len(qpos))
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(task.model, data)
        mujoco.mj_collision(task.model, data)
        depth[i] = max([0.0, *(-c.dist for c in data.contact[: data.ncon] if ball in (c.geom1, c.geom2))])
    return depth


def drive(engine: Engine, qpos: np.ndarray, qvel: np.ndarray, force: np.ndarray, steps: int) -> np.ndarray:
    """States (steps + 1, B, 4) under constant forces; B is filled up to whole batches."""
    qpos, qvel, force = (np.asarray(x, np.float32) for x in (qpos, qvel, force))
    runs = []
    for i in range(0, len(qpos), BATCH):
        q, v, f = (np.resize(x[i : i + BATCH], (BATCH, 2)) for x in (qpos, qvel, force))
        state = reset(jnp.asarray(q), jnp.asarray(v))
        states = [np.concatenate([q, v], axis=1)]
        for _ in range(steps):
            state = stepper(engine)(state, jnp.asarray(f))
            states.append(np.concatenate([state.qpos, state.qvel], axis=1))
        assert not state.bad.any()
        runs.append(np.stack(states)[:, : len(qpos) - i])
    return np.concatenate(runs, axis=1)


class TestModel:
    def test_numbers(self, task: Task) -> None:
        model = task.model
        assert model.opt.timestep == 0.02
        assert task.horizon == 500
        assert not model.opt.gravity.any()
        assert model.nq == model.nv == model.nu == 2
        ball = model.body("ball").id
        assert model.body_mass[ball] == 0.4189
        assert model.geom("ball").size[0] == 0.1
        assert not model.dof_damping.any()
        assert not model.dof_armature.any()
        assert not model.dof_frictionloss.any()
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-2, 2], [-2, 2]])
        assert (model.pair_dim == 1).all()

    def test_action_of_one_is_a_force_of_2_newton(self, task: Task) -> None:
        state = task.step(task.reset(task.goal_starts()), jnp.array([[1.0, -0.5]]))
        np.testing.assert_allclose(state.qvel[0], np.array([2.0, -1.0]) / 0.4189 * 0.02, rtol=1e-5)

    def test_open_cells(self) -> None:
        expected = {(x, -4) for x in range(-4, 5, 2)} | {(-4, -2), (4, -2), (-4, 0), (0, 0), (2, 0), (4, 0), (-4, 2)}
        expected |= {(x, 4) for x in range(-4, 5, 2)}
        assert {tuple(c) for c in PointMaze.maze.open_centres.astype(int)} == expected
        assert len(expected) == 17


class TestTask:
    def test_goal(self, task: Task) -> None:
        angle = np.linspace(0, 2 * np.pi, 9)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        qpos = np.concatenate([task.goal_state[None], (4, 4) + 0.299 * ring, (4, 4) + 0.301 * ring, [[-4.0, 4.0]]])
        s = task.snapshot(reset(jnp.asarray(qpos, jnp.float32), jnp.zeros(qpos.shape)))
        np.testing.assert_array_equal(jax.vmap(task.is_goal)(s), [True] * 10 + [False] * 10)
        np.testing.assert_allclose(np.asarray(jax.vmap(task.distance)(s))[[0, 1, -1]], [0, 0.299, 8], atol=1e-5)

    def test_feasible_where_the_ball_overlaps_no_wall(self, task: Task) -> None:
        qpos = np.random.default_rng(0).uniform(-6.9, 6.9, (3000, 2)).astype(np.float32)
        got = np.asarray(jax.vmap(task.is_feasible)(task.snapshot(reset(jnp.asarray(qpos), jnp.zeros(qpos.shape)))))
        np.testing.assert_array_equal(got, overlap(task, qpos) == 0)
        assert got.sum() > 300


class TestCorridor:
    @pytest.mark.slow
    def test_from_its_far_end_to_the_goal_within_an_episode(self, tasks: dict[str, Task], engine: Engine) -> None:
        """Full force along the corridor, walls as brakes: with gentler driving 10 s would not be enough."""
        task = tasks[engine.name]
        batch = BATCH
        start = np.tile(np.float32(CORRIDOR[0]), (batch, 1)) + np.random.default_rng(0).uniform(-0.5, 0.5, (batch, 2))
        state = reset(jnp.asarray(start, jnp.float32), jnp.zeros((batch, 2)))
        corners, leg = np.array(CORRIDOR, float), np.ones(batch, int)
        solved = np.zeros(batch, bool)
        for _ in range(task.horizon):
            x, v = np.asarray(state.qpos), np.asarray(state.qvel)
            leg = np.where((np.abs(x - corners[leg]).max(1) < 0.9) & (leg < len(corners) - 1), leg + 1, leg)
            direction = np.sign(corners[leg] - corners[leg - 1])
            across = 6 * (corners[leg] - x) - 4 * v  # hold the middle
            force = np.where(direction != 0, 2 * direction, np.clip(across, -2, 2))
            braking = v[:, :1] ** 2 / (2 * 2 / 0.4189) > np.abs(corners[-1] - x)[:, :1] - 0.3
            force[:, :1] = np.where((leg == len(corners) - 1)[:, None] & braking, -2, force[:, :1])
            state = stepper(engine)(state, jnp.asarray(force, jnp.float32))
            solved |= np.asarray(jax.vmap(task.is_goal)(task.snapshot(state)))
        assert solved.all()


class TestWalls:
    def test_hold_at_top_speed(self, tasks: dict[str, Task], engine: Engine) -> None:
        """From 1,000 random states at top speed in any direction: no centre in a wall, no overlap that lasts."""
        rng = np.random.default_rng(0)
        qpos = np.asarray(tasks["native"].sample_feasible(jax.random.key(3), 1000).qpos)
        axes = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)], float)[rng.integers(4, size=1000)]
        angle = rng.uniform(0, 2 * np.pi, 1000)
        anyhow = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        direction = np.where(np.arange(1000)[:, None] % 2 == 0, axes, anyhow)
        distance = box_distance(drive(engine, qpos, TOP_SPEED * direction, 0 * direction, 200)[..., :2])
        assert distance.min() > 0
        assert (distance.min(0) < 0.1).any()  # some get in
        assert distance[-50:].min() > 0.1 - 1e-3  # none is left there

    @pytest.mark.slow
    def test_hold_against_full_force(self, tasks: dict[str, Task], engine: Engine) -> None:
        """From 1,000 random states at rest, pushed in one direction for a whole episode."""
        angle = np.random.default_rng(1).uniform(0, 2 * np.pi, 1000)
        force = 2 * np.sign(np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1), 1))
        qpos = np.asarray(tasks["native"].sample_feasible(jax.random.key(4), 1000).qpos)
        states = drive(engine, qpos, 0 * qpos, force, 500)
        distance = box_distance(states[..., :2])
        assert distance.min() > 0
        assert distance[-50:].min() > 0.1 - 2e-3
        assert np.abs(states[-1, :, 2:]).max() < 0.01  # caught in some corner

    def test_sliding_along_keeps_the_speed(self, engine: Engine) -> None:
        """Pressed against every face of the maze, from within the bumper's reach or from outside, over all joints."""
        faces = [  # from, to, where the wall is
            ((-4.5, -5), (4.5, -5), (0, -1)),
            ((-2.6, -3), (2.6, -3), (0, 1)),
            ((-5, -4.5), (-5, 4.5), (-1, 0)),
            ((-3, -2.6), (-3, 2.6), (1, 0)),
            ((-4.5, 5), (4.5, 5), (0, 1)),
            ((-2.6, 3), (4.5, 3), (0, -1)),
            ((5, -4.5), (5, 0.5), (1, 0)),
            ((-0.5, 1), (4.5, 1), (0, 1)),
        ]
        cases = []
        for (a, b, wall), turn, gap, speed in itertools.product(faces, (1, -1), (0.105, 0.15, 0.25), (1.0, 3.0, 8.0)):
            first, last = (np.array(x, float) - gap * np.array(wall) for x in (a, b)[::turn])
            cases.append((first, last, wall, speed))
        first, last, wall, speed = (np.array(x, float) for x in zip(*cases))
        length = np.linalg.norm(last - first, axis=1)
        along = (last - first) / length[:, None]
        states = drive(engine, first, speed[:, None] * along, 2 * wall, 460)
        on_the_way = np.einsum("tbk,bk->tb", states[..., :2] - first, along) < length
        on_the_way = np.logical_and.accumulate(on_the_way)
        rate = np.einsum("tbk,bk->tb", states[..., 2:], along) / speed
        assert on_the_way.sum() > 10_000
        np.testing.assert_allclose(rate[on_the_way], 1, atol=1e-4)
        assert wall_distance(states[..., :2])[on_the_way].min() > 0.1 - 2e-3
