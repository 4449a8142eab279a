"""Righting tilted ants: torques against single steps of C MuJoCo, and what the search calls righted."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from experiments import ant_reach
from experiments.ant_reach import MOVE, REST, Outcome, play_torques, search, upright
from rcg_jax.tasks import make_task
from rcg_jax.tasks.ant_maze import AntMaze


@pytest.fixture(scope="module")
def task() -> AntMaze:
    found = make_task("ant_maze", "native")
    assert isinstance(found, AntMaze)
    return found


@pytest.fixture(scope="module")
def tilted(task: AntMaze) -> np.ndarray:
    qpos = np.asarray(task.feasible_starts().qpos, float)
    return qpos[upright(qpos) < ant_reach.TILTED]


def replay(task: AntMaze, qpos: np.ndarray, actions: np.ndarray) -> tuple[mujoco.MjData, int, np.ndarray]:
    """One sequence in C MuJoCo: its end, the step of its fall, and the torso's z axis over the vertical by step."""
    data = mujoco.MjData(task.model)
    fell, tilt = MOVE + REST, np.zeros(MOVE + REST)
    data.qpos[:] = qpos
    low, high = task.model.actuator_ctrlrange.T
    for t in range(MOVE + REST):
        data.ctrl[:] = low + (actions[t // ant_reach.KNOT] + 1) / 2 * (high - low) if t < MOVE else 0
        mujoco.mj_step(task.model, data)
        if not task.heights[0] <= data.qpos[2] <= task.heights[1]:
            fell = min(fell, t)
        frame = np.zeros(9)
        mujoco.mju_quat2Mat(frame, data.qpos[3:7] / np.linalg.norm(data.qpos[3:7]))
        tilt[t] = frame[8]
    return data, fell, tilt


def test_the_torques_are_those_of_single_steps(task: AntMaze, tilted: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (6, MOVE // ant_reach.KNOT, task.model.nu))
    outcome = play_torques(task, Batch(task.model, 6), tilted[:6], actions)
    falls = []
    for k in range(6):
        data, fell, tilt = replay(task, tilted[k], actions[k])
        falls.append(fell)
        np.testing.assert_allclose(outcome.qpos[k], data.qpos, atol=1e-6)
        np.testing.assert_allclose(outcome.qvel[k], data.qvel, atol=1e-5)
        assert outcome.fell[k] == fell
        assert outcome.tilt[k] == pytest.approx(tilt[MOVE + REST // 2 :].mean(), abs=1e-6)
    assert len({*falls}) > 1  # some fall, at different steps


def test_a_tilted_ant_stays_as_it_is_without_torques(task: AntMaze, tilted: np.ndarray) -> None:
    num = 32
    none = np.zeros((num, MOVE // ant_reach.KNOT, task.model.nu))
    outcome = play_torques(task, Batch(task.model, num), tilted[:num], none)
    assert (outcome.fell >= task.settle_steps).all()  # S^0 has none that fall before; after it a few do
    assert not outcome.righted.any()


def test_standing_counts_only_without_a_fall() -> None:
    qpos = np.zeros((3, 15))
    qpos[:, 3:7] = [1, 0, 0, 0]
    qpos[2, 3:7] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]  # on its side
    fell = np.array([MOVE + REST, 7, MOVE + REST])
    outcome = Outcome(qpos, np.zeros((3, 14)), fell, tilt=np.array([1.0, 1.0, -1.0]))
    np.testing.assert_allclose(upright(qpos), [1, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(outcome.righted, [True, False, False])
    # Whatever stands is better than whatever falls, and the later fall than the earlier.
    assert outcome.score[0] > outcome.score[2] > outcome.score[1]
    assert Outcome(qpos, qpos, np.array([7, 8, 9]), np.ones(3)).score.argsort().tolist() == [0, 1, 2]


@pytest.mark.slow
def test_the_search_rights_tilted_ants(task: AntMaze, tilted: np.ndarray) -> None:
    ways = search(task, tilted[::60], 15, np.random.default_rng(0))
    assert sum(map(bool, ways)) >= 2
    for way in ways:
        for state in way:
            # What it left stands: C MuJoCo says so after another second without torques.
            data = mujoco.MjData(task.model)
            data.qpos[:], data.qvel[:] = np.split(state, [task.model.nq])
            assert upright(data.qpos) > ant_reach.RIGHTED
            mujoco.mj_step(task.model, data, nstep=50)
            assert task.heights[0] <= data.qpos[2] <= task.heights[1]
            assert upright(data.qpos) > 0.8
