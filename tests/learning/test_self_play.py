"""Alice moves away from the goal, stops, and is paid for what Bob finds hard."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rcg_jax.config.settings import (
    BaselineConfig,
    Config,
    CurriculumConfig,
    PolicyConfig,
    RolloutConfig,
    SelfPlayConfig,
    TrpoConfig,
)
from rcg_jax.methods.self_play import SelfPlay, alice_episodes, alice_iteration, improve_alice
from rcg_jax.rl.agent import Agent, init_agent
from rcg_jax.types import StartSet
from tests.analytic import Line

NEW, OLD = 60, 20
TASK = Line(gain=0.05, horizon=20, feasible_radius=1.0)
CONFIG = Config(
    method="self_play",
    curriculum=CurriculumConfig(num_new=NEW, num_old=OLD, replay_capacity=200),
    rollout=RolloutConfig(num_envs=20, batch_size=600),
    trpo=TrpoConfig(iterations=2, max_kl=0.02, gamma=0.99, fisher_fraction=0.5, cg_damping=0.02),
    policy=PolicyConfig(hidden=[8], output_gain=0.0, obs_norm_iterations=2),
    baseline=BaselineConfig(hidden=[8], minibatch_size=100, learning_rate=1e-2),
    self_play=SelfPlayConfig(stop_threshold=0.8),
)
HORIZON = 40
#: Probability that Alice stops in a step: tanh of a standard normal exceeds 0.8.
STOP = float(stats.norm.sf(np.arctanh(0.8)))


def alice(config: Config = CONFIG) -> Agent:
    return init_agent(config, jax.random.key(3), TASK.obs_dim, TASK.action_dim + 1)


def episodes(task: Line = TASK, num: int = 500, seed: int = 0) -> Any:
    return jax.device_get(
        jax.jit(lambda k, a: alice_episodes(task, CONFIG, k, a, num=num, horizon=HORIZON))(
            jax.random.key(seed), alice()
        )
    )


def test_alice_can_stop_however_little_noise_the_settings_allow() -> None:
    config = dataclasses.replace(CONFIG, policy=dataclasses.replace(CONFIG.policy, init_std=0.25))
    std = jnp.exp(SelfPlay(Line(), config).init(jax.random.key(0)).alice.policy.log_std)
    np.testing.assert_allclose(std, [0.25, 1.0], rtol=1e-6)


def test_an_episode_ends_where_alice_stops() -> None:
    e = episodes()
    assert e.obs.shape == (HORIZON, 500, 2)
    assert np.all(e.last.sum(axis=0) == 1)
    ended = e.last.argmax(axis=0)
    np.testing.assert_array_equal(e.length, ended + 1)
    np.testing.assert_array_equal(e.alive, np.arange(HORIZON)[:, None] <= ended)
    stop = np.tanh(e.action[..., -1]) > 0.8
    for i in range(500):
        assert not stop[: ended[i], i].any()
        assert stop[ended[i], i] or ended[i] == HORIZON - 1 or not e.proposals.valid[i]
    # Geometric, up to the horizon (hardly any walk leaves |x| < 1 in so short a time).
    inside = e.proposals.valid
    assert inside.mean() > 0.95
    expected = (1 - (1 - STOP) ** HORIZON) / STOP
    spread = stats.geom(STOP).std() / np.sqrt(500)
    assert abs(e.length.mean() - expected) < 4 * spread


def test_proposals_are_where_she_stopped_at_rest() -> None:
    e = episodes()
    moves = np.where(e.alive, np.clip(e.action[..., 0], -1, 1), 0.0)
    np.testing.assert_allclose(e.proposals.qpos[:, 0], TASK.gain * moves.sum(axis=0), atol=1e-5)
    np.testing.assert_array_equal(e.proposals.qpos[:, 1], e.length)  # the clock of the task stopped with her
    assert not e.proposals.qvel.any()
    last = e.length - 1
    np.testing.assert_allclose(e.next_obs[last, np.arange(500), 0], e.proposals.qpos[:, 0], atol=1e-6)


def test_what_leaves_the_region_or_fails_is_no_proposal() -> None:
    small = episodes(Line(gain=0.05, horizon=20, feasible_radius=0.1))
    out = np.abs(small.proposals.qpos[:, 0]) >= 0.1
    np.testing.assert_array_equal(small.proposals.valid, ~out)
    assert 0.1 < out.mean() < 0.9
    assert small.length[out].mean() < HORIZON / 2  # they end there
    failed = episodes(Line(gain=0.05, horizon=20, fail_above=0.1))
    np.testing.assert_array_equal(failed.proposals.valid, failed.proposals.qpos[:, 0] <= 0.1)


def test_the_reward_is_bobs_time_less_hers() -> None:
    seen = []

    def bob_time(key: Any, starts: StartSet, t_alice: Any) -> Any:
        seen.append(starts.capacity)
        t_bob = jnp.where(starts.qpos[:, 0] > 0, 30, 3)
        return t_bob, t_bob + 1

    run = jax.jit(lambda k, a: alice_iteration(TASK, CONFIG, k, a, bob_time=bob_time, learn_norm=jnp.bool_(True)))
    _, proposals, got = run(jax.random.key(0), alice())
    assert set(seen) == {NEW}
    t_alice = np.asarray(proposals.qpos[:, 1])
    t_bob = np.where(np.asarray(proposals.qpos[:, 0]) > 0, 30, 3)
    valid = np.asarray(proposals.valid)
    assert got.alice_reward == pytest.approx(np.mean(np.maximum(0, t_bob - t_alice) * valid), rel=1e-5)
    assert got.alice_steps == pytest.approx(t_alice.mean())
    qpos = np.asarray(proposals.qpos)[valid]
    assert got.alice_spread == pytest.approx(np.sqrt(((qpos - qpos.mean(0)) ** 2).sum(1).mean()), rel=1e-4)
    assert got.steps == t_alice.sum() + (t_bob + 1)[valid].sum()


def test_padding_has_no_part_in_what_alice_learns() -> None:
    e = jax.tree.map(jnp.asarray, episodes(num=100))
    reward = jnp.linspace(0.0, 1.0, 100)
    update_agent = jax.jit(
        lambda e: improve_alice(
            CONFIG,
            jax.random.key(1),
            alice(),
            episodes=e,
            reward=reward,
            learn_norm=jnp.bool_(True),
            batch=CONFIG.rollout.batch_size,
        )
    )

    def spoil(x: Any, by: float) -> Any:
        return jnp.where(e.alive.reshape(*e.alive.shape, *(1,) * (x.ndim - 2)), x, by)

    spoiled = dataclasses.replace(
        e, obs=spoil(e.obs, 50.0), next_obs=spoil(e.next_obs, -50.0), action=spoil(e.action, 9.0)
    )
    first, second = update_agent(e), update_agent(spoiled)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert not np.allclose(first.policy.mlp["params"]["Dense_1"]["bias"], 0.0)


def test_alice_learns_to_go_where_bob_is_slow() -> None:
    """Bob is lost beyond x = 0.3, on one side only."""

    def bob_time(key: Any, starts: StartSet, t_alice: Any) -> Any:
        t_bob = jnp.where(starts.qpos[:, 0] > 0.3, HORIZON, 1)
        return t_bob, t_bob

    step = jax.jit(lambda k, a: alice_iteration(TASK, CONFIG, k, a, bob_time=bob_time, learn_norm=jnp.bool_(False)))
    agent, rewards, beyond = alice(), [], []
    for i in range(40):
        agent, proposals, got = step(jax.random.fold_in(jax.random.key(0), i), agent)
        rewards.append(float(got.alice_reward))
        beyond.append(float(jnp.mean(proposals.qpos[:, 0] > 0.3)))
    assert np.mean(rewards[-5:]) > 2 * np.mean(rewards[:5])
    assert np.mean(beyond[-5:]) > 0.6 > 0.3 > np.mean(beyond[:5])


@pytest.mark.slow
@pytest.mark.parametrize("fail_above", [np.inf, 0.1])
def test_bob_has_the_rest_of_the_shared_horizon(fail_above: float) -> None:
    """Where Bob never arrives, Alice earns what she left of it, also where he fails early."""
    never = Line(gain=0.05, horizon=20, goal_radius=-1.0, fail_above=fail_above)
    method = SelfPlay(never, CONFIG)
    agent = init_agent(CONFIG, jax.random.key(0), never.obs_dim, never.action_dim)
    state, starts = jax.jit(method.propose)(jax.random.key(0), method.init(jax.random.key(1)), agent)
    new = starts.take(jnp.arange(NEW))
    t_alice, valid = np.asarray(new.qpos[:, 1]), np.asarray(new.valid)
    t_bob = np.maximum(5, 2 * never.horizon - t_alice)
    assert state.stats.alice_reward == pytest.approx(np.mean(np.maximum(0, t_bob - t_alice) * valid), rel=1e-5)
    assert valid.all() == np.isinf(fail_above)
    # Steps that were really made: all of Bob's time, unless he fails.
    most = t_alice.sum() + t_bob[valid].sum()
    assert state.stats.steps == most if np.isinf(fail_above) else state.stats.steps < 0.9 * most
    assert starts.capacity == NEW + OLD
    assert not np.any(starts.qpos[NEW:])  # the replay: the goal
