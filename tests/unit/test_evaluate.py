"""Evaluation on tasks with known success probabilities, and the confidence interval."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rcg_jax.config.settings import BaselineConfig, Config, PolicyConfig
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.evaluate.success import EvalResult, make_evaluate
from rcg_jax.rl.agent import make_policy
from rcg_jax.train_step import TrainState, init_train_state
from tests.analytic import Coin, Line

#: A mean of exactly 0 and a standard deviation of 1: the policy that Coin's probabilities are for.
CONFIG = Config(
    method="uniform",
    policy=PolicyConfig(hidden=[4], init_std=1.0, output_gain=0.0),
    baseline=BaselineConfig(hidden=[4]),
)

#: The mean action 0 lies below every threshold but the last one's, whose success is the likelier outcome.
COIN = Coin([0.02, 0.05, 0.1, 0.7], failure=0.03, nonfinite=0.02, horizon=12)
EPISODES = 3_000


@pytest.fixture(scope="module")
def state() -> TrainState:
    return init_train_state(CONFIG, COIN, 0)


@pytest.fixture(scope="module")
def evaluate() -> Any:
    return jax.jit(make_evaluate(make_policy(CONFIG, COIN.action_dim), COIN, EPISODES))


@pytest.fixture(scope="module")
def result(evaluate: Any, state: TrainState) -> EvalResult:
    return evaluate(state.agent.actor, jax.random.key(0))


def test_stochastic_success_agrees_with_the_known_probability(result: EvalResult) -> None:
    low, high = wilson_interval(int(result.successes_stochastic), EPISODES, z=3.5)
    assert low < COIN.success_probability.mean() < high
    assert high - low < 0.07
    # and from each start
    start, success = np.asarray(result.start), np.asarray(result.stochastic.success)
    for i, p in enumerate(COIN.success_probability):
        low, high = wilson_interval(int(success[start == i].sum()), int(np.sum(start == i)), z=3.5)
        assert low < p < high


def test_mean_policy_is_deterministic(evaluate: Any, state: TrainState, result: EvalResult) -> None:
    """Known outcome of each start, whatever the key; both policies are tried from the same starts."""
    for key in (0, 1):
        again = evaluate(state.agent.actor, jax.random.key(key))
        easy = np.asarray(again.start) == 3
        np.testing.assert_array_equal(again.mean.success, easy)
        np.testing.assert_array_equal(again.mean.length, np.where(easy, 1, COIN.horizon))
        assert not np.any(again.mean.bad)
    assert not np.array_equal(again.stochastic.success, result.stochastic.success)
    again = evaluate(state.agent.actor, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, again, result)


def test_lengths_and_ends_of_episodes(result: EvalResult) -> None:
    """Goal, failure and bad physics end an episode; without them it takes the whole horizon."""
    episodes = jax.tree.map(np.asarray, result.stochastic)
    start, length = np.asarray(result.start), episodes.length
    assert not np.any(episodes.success & episodes.bad)
    assert length.min() == 1
    assert length.max() == COIN.horizon
    for i, success in enumerate([0.02, 0.05, 0.1, 0.7]):
        mine = start == i
        # P(length > t) = (1 - p)^t with p the probability of any end in one step
        go_on = 1 - success - 0.05
        for t in (1, 5, COIN.horizon - 1):
            n, k = int(mine.sum()), int(np.sum(mine & (length > t)))
            low, high = wilson_interval(k, n, z=4.0)
            assert low <= go_on**t <= high
        n, k = int(mine.sum()), int(episodes.bad[mine].sum())
        low, high = wilson_interval(k, n, z=4.0)
        assert low <= 0.02 / (1 - go_on) * (1 - go_on**COIN.horizon) <= high


def test_evaluation_uses_the_trained_policy_and_its_observation_statistics() -> None:
    """A hand-made policy a = -tanh-like(x) solves the line; with observations displaced it does not."""
    line = Line(horizon=40)
    config = dataclasses.replace(CONFIG, policy=dataclasses.replace(CONFIG.policy, init_std=0.1))
    state = init_train_state(config, line, 0)
    evaluate = jax.jit(make_evaluate(make_policy(config, line.action_dim), line, 100))
    params = state.agent.policy.mlp["params"]
    first = {**params["Dense_0"], "kernel": jnp.zeros((2, 4)).at[0, 0].set(20.0)}
    last = {**params["Dense_1"], "kernel": jnp.zeros((4, 1)).at[0, 0].set(-1.0)}
    policy = dataclasses.replace(state.agent.policy, mlp={"params": {"Dense_0": first, "Dense_1": last}})
    solved = dataclasses.replace(state.agent.actor, policy=policy)
    result = evaluate(solved, jax.random.key(0))
    assert result.successes_mean == 100
    assert result.successes_stochastic > 95
    norm = dataclasses.replace(solved.norm, mean=jnp.array([5.0, 0.0]))
    result = evaluate(dataclasses.replace(solved, norm=norm), jax.random.key(0))
    assert result.successes_mean < 60


def test_wilson_interval_agrees_with_scipy() -> None:
    for episodes in (1, 2, 7, 50, 500, 2_000):
        for successes in sorted({0, 1, episodes // 3, episodes // 2, episodes - 1, episodes}):
            expected = stats.binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
            low, high = wilson_interval(successes, episodes)
            assert low == pytest.approx(expected.low, abs=1e-6)
            assert high == pytest.approx(expected.high, abs=1e-6)
            assert 0.0 <= low <= high <= 1.0
