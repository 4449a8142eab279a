"""The kinematic bound of ring_peg: inverse kinematics against C MuJoCo's forward kinematics."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from experiments import ring_reach
from experiments.ring_reach import Arm
from rcg_jax.tasks.ring_peg import RingPeg


@pytest.fixture(scope="module")
def task(ring_peg_native: RingPeg) -> RingPeg:
    return ring_peg_native


def test_solutions_put_the_disk_where_it_was_asked_for(task: RingPeg) -> None:
    arm, data, rng = Arm.of(task.model), mujoco.MjData(task.model), np.random.default_rng(0)
    poses, count = ring_reach.goal_poses(task), 0
    for _ in range(60):
        centre, normal = poses[rng.integers(len(poses))]
        pan, lift = rng.uniform([0.0, 0.0], [0.9, 1.39])
        for q in arm.solve(pan, lift, centre, normal):
            data.qpos[:] = q
            mujoco.mj_kinematics(task.model, data)
            frame = data.body("wrist_roll").xmat.reshape(3, 3)
            np.testing.assert_allclose(data.site("disk").xpos, centre, atol=1e-5)
            assert abs(frame[:, 2] @ normal) == pytest.approx(1.0, abs=1e-6)
            assert (q >= arm.low).all()
            assert (q <= arm.high).all()
            count += 1
    assert count > 20


def test_no_solution_is_missed(task: RingPeg) -> None:
    # Whatever the arm does, the disk is somewhere: asked for that, the solver has to find the same arm again.
    arm, data, rng = Arm.of(task.model), mujoco.MjData(task.model), np.random.default_rng(1)
    for _ in range(300):
        q = rng.uniform(arm.low, arm.high)
        data.qpos[:] = q
        mujoco.mj_kinematics(task.model, data)
        normal = data.body("wrist_roll").xmat.reshape(3, 3)[:, 2]
        found = list(arm.solve(q[0], q[1], data.site("disk").xpos.copy(), normal))
        assert min(np.abs(x - q).max() for x in found) < 1e-3


def test_turns_that_starts_need(task: RingPeg) -> None:
    # The goal state's own shoulder has a goal configuration; arms that point away from the peg have none.
    pan, lift = task.goal_state[[0]], task.goal_state[[1]]
    near = ring_reach.goal_shoulders(task, pan, lift)
    np.testing.assert_allclose(near, [task.goal_state[:2]])
    assert not len(ring_reach.goal_shoulders(task, np.array([-2.0]), lift))
    starts = np.stack([task.goal_state, task.goal_state])
    starts[1, :2] += 0.2, -0.7
    np.testing.assert_allclose(ring_reach.needed_turn(starts, near, grid=0.1), [0.0, 0.65])
    # 1 N m against 10 N m s/rad for 500 steps of 0.01 s.
    assert ring_reach.own_turn(task) == pytest.approx(0.5)


def test_a_configuration_in_the_peg_is_no_goal(task: RingPeg) -> None:
    data = mujoco.MjData(task.model)
    assert ring_reach.is_goal_configuration(task, data, task.goal_state)
    # Its disk stays within 3 cm of the goal, but a bar of the ring is in the peg.
    arm = Arm.of(task.model)
    goal = task.model.site("goal").pos
    offsets = 0.025 * np.stack([np.cos(np.arange(8.0)), np.sin(np.arange(8.0)), np.full(8, 0.2)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    beside = [q for offset in offsets for q in arm.solve(*task.goal_state[:2], goal + offset, up)]
    assert beside
    assert not any(ring_reach.is_goal_configuration(task, data, q) for q in beside)
