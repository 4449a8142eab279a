"""The Gymnasium vector environment: spaces, seeding, given states, autoreset, and agreement with our own episodes."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rcg_jax.gymnasium import TaskVectorEnv, make, make_vec
from rcg_jax.types import StartSet
from tests.analytic import Line, make_starts


@pytest.fixture(scope="module")
def ring() -> TaskVectorEnv:
    return make_vec("ring_peg", 6)


def line(num_envs: int, positions: Any = (0.5,), repeat: int = 1, **settings: Any) -> TaskVectorEnv:
    """The analytic task, whose every step moves by 0.05; the goal is within 0.05 of 0."""
    task = Line(**settings)
    task.engine.fusion_emitters = True
    starts = make_starts(np.stack([np.asarray(positions), *np.zeros((2, len(positions)))], axis=1))
    return TaskVectorEnv(task, num_envs, starts=starts, action_repeat=repeat)


def test_follows_the_protocol_of_gymnasium(ring: TaskVectorEnv) -> None:
    assert isinstance(ring, gymnasium.vector.VectorEnv)
    assert ring.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    obs, infos = ring.reset(seed=1)
    assert ring.observation_space.contains(obs)
    assert infos["start"].shape == (6,)
    obs, reward, terminated, truncated, _ = ring.step(ring.action_space.sample())
    assert ring.observation_space.contains(obs)
    assert reward.dtype == np.float64
    assert terminated.dtype == truncated.dtype == bool


def test_the_action_of_a_trained_task_is_held(ring: TaskVectorEnv) -> None:
    assert ring.action_repeat == 4
    assert make_vec("point_maze", 1).action_repeat == 1


def test_equal_seeds_are_equal_and_others_differ(ring: TaskVectorEnv) -> None:
    first = ring.reset(seed=3)[0]
    later = ring.reset()[0]
    assert (ring.reset(seed=3)[0] == first).all()
    assert (ring.reset()[0] == later).all()
    assert not (first == later).all()
    assert not (ring.reset(seed=4)[0] == first).all()


def test_steps_are_those_of_the_task(ring: TaskVectorEnv) -> None:
    everywhere = ring.task.feasible_starts()
    away = np.asarray(jax.vmap(ring.task.distance)(ring.task.snapshot(ring.task.reset(everywhere)))) > 0.2
    starts = everywhere.take(np.flatnonzero(away)[:6])
    obs, infos = ring.reset(options={"qpos": np.asarray(starts.qpos)})  # a copy: later steps do not change it
    assert (infos["start"] == -1).all()
    action = ring.action_space.sample()
    seen = ring.step(action)[0]
    state = ring.task.reset(starts)
    np.testing.assert_allclose(obs, ring.task.observe_batch(state), atol=1e-6)
    for _ in range(4):
        state = ring.task.step(state, jnp.asarray(action))
    np.testing.assert_allclose(seen, ring.task.observe_batch(state), atol=1e-5)


def test_only_masked_environments_are_reset(ring: TaskVectorEnv) -> None:
    ring.reset(seed=0)
    before = ring.step(ring.action_space.sample())[0]
    mask = np.array([True, False] * 3)
    after = ring.reset(options={"reset_mask": mask})[0]
    assert (after[~mask] == before[~mask]).all()
    assert (after[mask] != before[mask]).any(axis=1).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"qpos": np.zeros((5, 7))}, r"qpos: must have the shape \(6, 7\)"),
        ({"qvel": np.zeros((6, 7))}, "qvel: needs qpos, too"),
        ({"qpos": np.full((6, 7), np.nan)}, "finite"),
        ({"reset_mask": np.zeros(6)}, r"reset_mask: must be \(6,\) bool"),
        ({"state": 0}, "options: state unknown"),
    ],
)
def test_refused_options(ring: TaskVectorEnv, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ring.reset(options=options)


def test_refused_actions_and_numbers(ring: TaskVectorEnv) -> None:
    ring.reset(seed=0)
    with pytest.raises(ValueError, match="actions: must have the shape"):
        ring.step(np.zeros((6, 6)))
    with pytest.raises(ValueError, match="actions: NaN or infinite in rows"):
        ring.step(np.full((6, 7), np.nan))
    with pytest.raises(ValueError, match="num_envs=0"):
        make_vec("ring_peg", 0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        line(1).step(np.zeros((1, 1), np.float32))


def walk(env: TaskVectorEnv, actions: list[float]) -> list[Any]:
    """The same action in all environments, one after the other."""
    return [env.step(np.full(env.action_space.shape, a, np.float32)) for a in actions]


def test_the_goal_ends_an_episode_with_a_reward_and_the_next_begins() -> None:
    env = line(2, [0.14])
    env.reset(seed=0)
    (_, reward, terminated, truncated, infos), (obs, *_) = walk(env, [-1.0, -1.0])[1], walk(env, [1.0])[0]
    np.testing.assert_array_equal(reward, [1.0, 1.0])
    np.testing.assert_array_equal(terminated, [True, True])
    np.testing.assert_array_equal(truncated, [False, False])
    np.testing.assert_array_equal(infos["success"], [True, True])
    np.testing.assert_array_equal(infos["_final_obs"], [True, True])
    np.testing.assert_allclose(infos["final_obs"][:, 0], 0.04, atol=1e-6)
    np.testing.assert_allclose(obs[:, 0], 0.19, atol=1e-6)


def test_what_follows_the_last_action_is_the_next_start() -> None:
    env = line(1, [0.14])
    env.reset(seed=0)
    np.testing.assert_allclose(walk(env, [-1.0, -1.0])[1][0][:, 0], 0.14, atol=1e-6)


def test_time_runs_out() -> None:
    env = line(1, [0.5], horizon=5, repeat=2)
    env.reset(seed=0)
    outcomes = walk(env, [1.0, -1.0, 1.0])  # T is no multiple of the two steps
    assert [bool(o[3][0]) for o in outcomes] == [False, False, True]
    assert not any(o[2][0] for o in outcomes)
    assert not any(o[1][0] for o in outcomes)


@pytest.mark.parametrize("end", ["fail_above", "bad_above"])
def test_failures_and_numbers_that_are_not_finite_terminate_without_reward(end: str) -> None:
    env = line(1, [0.5], **{end: 0.52})
    env.reset(seed=0)
    _, reward, terminated, truncated, infos = walk(env, [1.0])[0]
    assert terminated[0]
    assert not truncated[0]
    assert reward[0] == 0
    assert np.isfinite(infos["final_obs"]).all()


def test_starts_are_drawn_from_the_valid_ones_and_can_be_replaced() -> None:
    env = line(64, [0.1, 0.2, 0.3, 0.4])
    some = StartSet(env.starts.qpos, env.starts.qvel, jnp.array([False, True, False, True]))
    env.set_starts(some)
    obs, infos = env.reset(seed=0)
    assert set(infos["start"]) == {1, 3}
    np.testing.assert_allclose(obs[:, 0], np.where(infos["start"] == 1, 0.2, 0.4), atol=1e-6)
    with pytest.raises(ValueError, match="none of them is valid"):
        env.set_starts(StartSet(some.qpos, some.qvel, jnp.zeros(4, bool)))


def test_one_environment_passes_the_checks_of_gymnasium() -> None:
    env = make("point_maze")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*spec|.*infinity")  # it is in no registry; observations have no bounds
        check_env(env)
    env.reset(options={"qpos": env.task.goal_state + np.array([0.0, -0.31])})
    obs, reward, terminated, truncated, infos = env.step(np.array([0.0, 1.0]))
    while not (terminated or truncated):
        obs, reward, terminated, truncated, infos = env.step(np.array([0.0, 1.0]))
    assert (reward, terminated, infos["success"]) == (1.0, True, True)
    assert np.linalg.norm(obs[:2] - env.task.goal_state) < 0.3  # the last observation, not that of a next start
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.array([0.0, 1.0]))


def test_quaternions_are_of_length_one() -> None:
    env = make_vec("ant_maze", 2)
    qpos = np.tile(env.task.goal_state, (2, 1))
    same, _ = env.reset(options={"qpos": qpos})
    qpos[:, 3:7] *= 7
    np.testing.assert_allclose(env.reset(options={"qpos": qpos})[0], same, atol=1e-6)
    qpos[1, 3:7] = 0
    with pytest.raises(ValueError, match=r"quaternion at \[3:7\] has length 0"):
        env.reset(options={"qpos": qpos})


def test_seeds_may_be_an_array() -> None:
    env = make_vec("point_maze", 3)
    first = env.reset(seed=np.arange(3))[0]
    np.testing.assert_array_equal(env.reset(seed=[0, 1, 2])[0], first)
    for wrong in (1.5, "a", -1, [1, 2]):
        with pytest.raises(ValueError, match="must be an integer >= 0"):
            env.reset(seed=wrong)


def test_starts_of_another_task_are_refused() -> None:
    with pytest.raises(ValueError, match="of another task"):
        make_vec("ring_peg", 2, starts=make_vec("point_maze", 2).starts)
    with pytest.raises(ValueError, match=r"must be a rcg_jax\.StartSet, not ndarray"):
        make_vec("ring_peg", 2, starts=np.zeros((3, 7)))
