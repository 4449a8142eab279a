"""The oracle finds starts of intermediate success, and counts what that costs."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax.config.settings import (
    Config,
    ConfigError,
    CurriculumConfig,
    OracleConfig,
    PolicyConfig,
)
from rcg_jax.methods.oracle import Oracle
from rcg_jax.rl.agent import Agent, init_agent, make_policy
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.types import StartLabels
from tests.analytic import ExactLine, Line

NEW, OLD = 60, 10
TASK = ExactLine(gain=0.05, horizon=30, feasible_radius=2.0)
CONFIG = Config(
    method="oracle",
    curriculum=CurriculumConfig(num_new=NEW, num_old=OLD, replay_capacity=100),
    oracle=OracleConfig(num_points=200, rollouts=3, max_rounds=10),
    policy=PolicyConfig(hidden=[8], output_gain=0.0),
)


def agent(push: float = 0.0, config: Config = CONFIG) -> Agent:
    """An agent whose mean action is ``push`` everywhere."""
    one = init_agent(config, jax.random.key(0), TASK.obs_dim, TASK.action_dim)
    mlp = jax.tree_util.tree_map_with_path(
        lambda path, x: x + push if "Dense_1" in str(path) and "bias" in str(path) else x, one.policy.mlp
    )
    return dataclasses.replace(one, policy=dataclasses.replace(one.policy, mlp=mlp))


def propose(config: Config = CONFIG, push: float = 0.0) -> tuple[Any, Any]:
    method = Oracle(TASK, config)
    state = method.init(jax.random.key(0))
    return jax.jit(method.propose)(jax.random.key(0), state, agent(push, config))


@pytest.fixture(scope="module")
def proposed() -> tuple[Any, Any]:
    return propose()


@pytest.mark.slow
def test_starts_are_of_intermediate_success(proposed: tuple[Any, Any]) -> None:
    """A random walk of 30 steps reaches 0 from nearby nearly always, from far away never."""
    state, starts = proposed
    assert starts.capacity == NEW + OLD
    assert np.all(starts.valid)
    assert not np.any(starts.qpos[NEW:])  # the replay holds but the goal
    repeated = jax.tree.map(lambda x: jnp.repeat(x, 400, axis=0), starts.take(jnp.arange(NEW)))
    run = jax.jit(lambda a, s: run_episodes(TASK, make_policy(CONFIG, 1), a, jax.random.key(7), s))
    rate = np.mean(np.asarray(run(agent(), repeated).success).reshape(NEW, 400), axis=1)
    # One or two of three episodes reached the goal. A start of success p passes with probability 3 p (1 - p).
    assert np.mean((rate > 0.05) & (rate < 0.98)) > 0.9
    assert 0.25 < rate.mean() < 0.75
    everywhere = TASK.sample_feasible(jax.random.key(1), 2_000).qpos[:, 0]
    assert np.mean(np.abs(starts.qpos[:NEW, 0])) < 0.5 * np.mean(np.abs(everywhere))
    assert state.labelling_steps > 0


def test_the_cost_is_what_the_episodes_took() -> None:
    """A policy that always fails from far: every episode of all rounds takes all T steps, or is short nearby."""
    config = dataclasses.replace(CONFIG, oracle=OracleConfig(num_points=50, rollouts=2, max_rounds=3))
    far = ExactLine(gain=1e-6, horizon=30, goal_radius=1e-3, feasible_radius=2.0)
    method = Oracle(far, config)
    state, starts = jax.jit(method.propose)(jax.random.key(0), method.init(jax.random.key(0)), agent(0.0, config))
    episodes = 50 * 2 * 3
    assert episodes * 29 < state.labelling_steps <= episodes * 30
    _, metrics = jax.jit(method.update)(jax.random.key(1), state, starts, StartLabels.none(NEW + OLD))
    assert metrics.proposal_steps == state.labelling_steps


def test_rounds_end_when_there_are_enough(proposed: tuple[Any, Any]) -> None:
    few = dataclasses.replace(CONFIG, curriculum=dataclasses.replace(CONFIG.curriculum, num_new=3))
    cheap, _ = propose(few)
    dear, _ = proposed
    assert 0 < cheap.labelling_steps < 0.5 * dear.labelling_steps


@pytest.mark.slow
def test_without_good_starts_the_hard_ones_are_tried() -> None:
    """A certain push to the left solves all starts right of the goal and none left of it."""
    config = dataclasses.replace(CONFIG, policy=PolicyConfig(hidden=[8], output_gain=0.0, init_std=1e-4))
    task = ExactLine(gain=0.09, horizon=40, goal_radius=0.05, feasible_radius=2.0)
    method = Oracle(task, config)
    _, starts = jax.jit(method.propose)(jax.random.key(0), method.init(jax.random.key(0)), agent(-1.0, config))
    new = np.asarray(starts.qpos[:NEW, 0])
    assert np.all(np.asarray(starts.valid))
    assert np.all(new < 0)
    assert len(np.unique(new)) > NEW // 2


@pytest.mark.slow
def test_fewer_good_starts_than_asked_for_leave_rows_empty() -> None:
    config = dataclasses.replace(CONFIG, oracle=OracleConfig(num_points=40, rollouts=3, max_rounds=1))
    _, starts = propose(config)
    assert 0 < int(starts.valid[:NEW].sum()) < NEW
    assert np.all(starts.valid[NEW:])


def test_good_starts_enter_the_replay(proposed: tuple[Any, Any]) -> None:
    method = Oracle(TASK, CONFIG)
    state, starts = proposed
    good = np.arange(NEW + OLD) % 4 == 0
    labels = StartLabels(
        successes=jnp.where(jnp.asarray(good), 5, 10),
        episodes=jnp.full(NEW + OLD, 10),
        steps=jnp.full(NEW + OLD, 50),
    )
    after, metrics = jax.jit(method.update)(jax.random.key(1), state, starts, labels)
    assert int(after.replay.count()) == 1 + good.sum()
    assert metrics.share_good == pytest.approx(good.mean())


def test_a_task_without_a_sampler_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"method=oracle: task=line cannot .*; tasks that can: point_maze,"):
        Oracle(Line(), CONFIG)
