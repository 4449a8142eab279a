"""The train step: it learns, it is one pure function of its state, and nothing broken gets into it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax.config.settings import (
    BaselineConfig,
    Config,
    ConfigError,
    CurriculumConfig,
    PolicyConfig,
    PpoConfig,
    RolloutConfig,
    TrpoConfig,
)
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.physics.jit import jit
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.policy import ObsNormalizer
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.tasks.base import Task
from rcg_jax.train_step import Metrics, TrainState, init_train_state, make_train_step
from rcg_jax.types import StartLabels
from tests.analytic import Coin, Line

#: Small, and quick to learn from. The damping keeps conjugate gradients well conditioned, so that runs which differ by
#: rounding stay close.
CONFIG = Config(
    method="reverse",
    curriculum=CurriculumConfig(
        num_new=40,
        num_old=20,
        num_candidates=400,
        brownian_horizon=10,
        brownian_horizon_max=40,
        noise_std=1.0,
        noise="integrated",
        min_episodes=2,
        min_good=0.1,
        replay_capacity=400,
    ),
    rollout=RolloutConfig(num_envs=50, batch_size=1_000),
    trpo=TrpoConfig(iterations=3, max_kl=0.05, gamma=0.98, gae_lambda=0.95, fisher_fraction=0.2, cg_damping=0.02),
    policy=PolicyConfig(hidden=[16], init_std=1.0, obs_norm_iterations=3),
    baseline=BaselineConfig(hidden=[16], epochs=3, minibatch_size=100, learning_rate=5e-3),
)
STEPS_PER_ITERATION = 3 * 1_000

Step = Callable[[TrainState], tuple[TrainState, Metrics]]


def compiled(config: Config, task: Task) -> Step:
    return jit(make_train_step(config, task))


def train(step: Step, state: TrainState, iterations: int) -> tuple[TrainState, list[Metrics]]:
    history = []
    for _ in range(iterations):
        state, metrics = step(state)
        history.append(jax.tree.map(np.asarray, metrics))
    return state, history


def comparable(tree: Any) -> Any:
    """Leaves as numpy arrays; PRNG keys as their data."""

    def one(x: Any) -> np.ndarray:
        return np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    return jax.tree.map(one, tree)


def assert_identical(a: Any, b: Any) -> None:
    """Bit for bit."""
    jax.tree.map(np.testing.assert_array_equal, comparable(a), comparable(b))


@pytest.fixture(scope="module")
def line() -> Line:
    """Far starts are 20 steps of full speed away from the goal, of 40; a random walk rarely gets there."""
    return Line(horizon=40, gain=0.05, goal_radius=0.05)


@pytest.fixture(scope="module")
def step(line: Line) -> Step:
    return compiled(CONFIG, line)


@pytest.fixture(scope="module")
def trained(line: Line, step: Step) -> dict[int, tuple[TrainState, list[Metrics]]]:
    """12 iterations of two seeds."""
    return {seed: train(step, init_train_state(CONFIG, line, seed), 12) for seed in (0, 1)}


# ------------------------------------------------------------------------------------------------------- learning


@pytest.mark.slow
def test_learns_to_reach_the_goal_from_everywhere(
    line: Line, trained: dict[int, tuple[TrainState, list[Metrics]]]
) -> None:
    evaluate = jit(make_evaluate(make_policy(CONFIG, line.action_dim), line, 200))
    for seed, (state, history) in trained.items():
        before = evaluate(init_train_state(CONFIG, line, seed).agent.actor, jax.random.key(5))
        after = evaluate(state.agent.actor, jax.random.key(5))
        assert before.successes_stochastic < 0.6 * 200
        assert after.successes_stochastic > 0.9 * 200
        assert after.successes_mean > 0.9 * 200
        # the curriculum went backwards from the goal
        distance = [float(m.start_distance) for m in history]
        assert distance[-1] > 2 * distance[0]


def test_the_trust_region_follows_the_outcome_of_the_iteration_before(
    step: Step, trained: dict[int, tuple[TrainState, list[Metrics]]]
) -> None:
    """Not that of a batch: the first ones hold no episode that failed by time, however bad the policy is."""
    state, _ = trained[0]

    def kl(successes: int) -> float:
        labels = dataclasses.replace(
            StartLabels.none(state.starts.capacity),
            successes=state.labels.successes.at[:].set(successes),
            episodes=state.labels.episodes.at[:].set(10),
        )
        return float(step(dataclasses.replace(state, labels=labels))[1].kl)

    # All succeed in this state, so that failures counted in a batch would shrink both.
    assert kl(5) > 0.4 * CONFIG.trpo.max_kl
    assert kl(10) < 0.11 * CONFIG.trpo.max_kl


def test_counters_and_metrics(line: Line, trained: dict[int, tuple[TrainState, list[Metrics]]]) -> None:
    state, history = trained[0]
    assert int(state.iteration) == 12
    for i, m in enumerate(history):
        assert m.iteration == i + 1
        assert m.env_steps == STEPS_PER_ITERATION
        assert 0 < m.kl <= CONFIG.trpo.max_kl
        assert m.surrogate_gain > 0
        assert 0 < m.accepted <= 1
        assert 1 <= m.line_search_attempts <= CONFIG.trpo.max_backtracks
        assert 0.2 < m.policy_std < 2.0
        assert m.nonfinite == 0
        # Begun 40 or more steps before the end of 60: at least the first episode of each of the 50 environments
        assert m.episodes >= 50
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(m))
    last = history[-1]
    assert last.policy_std == pytest.approx(np.exp(np.asarray(state.agent.policy.log_std)).mean(), rel=1e-6)
    assert abs(last.policy_std - CONFIG.policy.init_std) > 1e-4  # it learns
    successes, episodes = np.asarray(state.labels.successes), np.asarray(state.labels.episodes)
    assert np.all(successes <= episodes)
    assert last.episodes == episodes.sum()
    assert last.success == pytest.approx(successes.sum() / episodes.sum())
    assert last.start_distance == pytest.approx(np.abs(np.asarray(state.starts.qpos)[:, 0]).mean(), rel=1e-5)
    assert last.starts.labelled == pytest.approx(np.mean(episodes >= 2))


def test_labels_of_a_whole_iteration_are_unbiased() -> None:
    """Through all segments of the train step: a policy that cannot move, on tosses with known probabilities."""
    task = Coin([0.01, 0.03, 0.08], horizon=40)
    config = dataclasses.replace(
        CONFIG,
        method="uniform",
        rollout=RolloutConfig(num_envs=300, batch_size=300 * 20),
        trpo=dataclasses.replace(CONFIG.trpo, max_kl=1e-9),
        policy=dataclasses.replace(CONFIG.policy, output_gain=0.0, obs_norm_iterations=1),
    )
    step, state = compiled(config, task), init_train_state(config, task, 0)
    successes, episodes, orders = np.zeros(3), np.zeros(3), set()
    for _ in range(8):
        state, metrics = step(state)
        number = np.asarray(state.starts.qpos)[:, 0].astype(int)
        np.add.at(successes, number, state.labels.successes)
        np.add.at(episodes, number, state.labels.episodes)
        orders.add(tuple(number))
        assert metrics.kl < 1e-8
    assert episodes.sum() > 8 * 300
    assert len(orders) > 1  # each iteration draws anew (six orders of three starts)
    p = task.success_probability
    assert np.all(np.abs(successes / episodes - p) < 4 * np.sqrt(p * (1 - p) / episodes))
    # Statistics of raw observations: an episode's age, about 9, 25 and 10 in the three segments.
    assert 10 < float(state.agent.norm.mean[1]) < 17


# ----------------------------------------------------------------------------------------------------------- pure


def test_is_deterministic(line: Line, step: Step, trained: dict[int, tuple[TrainState, list[Metrics]]]) -> None:
    """Same seed, same bits, also from a state that went through numpy on the way, as through a checkpoint."""
    state, _ = train(step, init_train_state(CONFIG, line, 0), 6)
    state = jax.tree.map(
        lambda x: x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else jnp.asarray(np.array(x)), state
    )
    state, history = train(step, state, 6)
    assert_identical(state, trained[0][0])
    assert_identical(history, trained[0][1][6:])


def stack(states: list[TrainState]) -> TrainState:
    return jax.tree.map(lambda *xs: jnp.stack(xs), *states)


@pytest.mark.slow
def test_seeds_side_by_side_equal_each_alone(
    line: Line, step: Step, trained: dict[int, tuple[TrainState, list[Metrics]]]
) -> None:
    """Up to rounding, which conjugate gradients amplify: over one iteration of several TRPO steps."""
    together = jit(jax.vmap(make_train_step(CONFIG, line)))
    state, history = train(together, stack([init_train_state(CONFIG, line, seed) for seed in (0, 1)]), 1)
    for seed in (0, 1):
        alone, _ = train(step, init_train_state(CONFIG, line, seed), 1)
        one = jax.tree.map(lambda x, s=seed: x[s], state)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-2, atol=1e-2),
            comparable((one.agent, one.starts, one.iteration, one.key)),
            comparable((alone.agent, alone.starts, alone.iteration, alone.key)),
        )
        mine = jax.tree.map(lambda x, s=seed: x[s], history[0])
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0.02, atol=0.02), mine, trained[seed][1][0])
    kernels = state.agent.policy.mlp["params"]["Dense_0"]["kernel"]
    assert not np.allclose(kernels[0], kernels[1], atol=0.1)


# ------------------------------------------------------------------------------------------- observation statistics


def test_observation_statistics_are_frozen_after_their_iterations(line: Line, step: Step) -> None:
    state = init_train_state(CONFIG, line, 0)
    counts, norms = [], []
    for _ in range(5):
        state, _ = step(state)
        counts.append(int(state.agent.norm.count))
        norms.append(state.agent.norm)
    assert counts == [STEPS_PER_ITERATION, 2 * STEPS_PER_ITERATION] + [3 * STEPS_PER_ITERATION] * 3
    assert not np.array_equal(norms[1].mean, norms[2].mean)
    assert_identical(norms[2], norms[3])
    assert_identical(norms[2], norms[4])


# ---------------------------------------------------------------------------------------------- non-finite physics


@pytest.mark.slow
def test_nonfinite_physics_stays_out() -> None:
    """Wherever x > 0.1 physics breaks: counted, a failed episode, and nowhere in the state."""
    task = Line(horizon=40, gain=0.05, goal_radius=0.05, bad_above=0.1)
    state, history = train(compiled(CONFIG, task), init_train_state(CONFIG, task, 0), 4)
    assert sum(int(m.nonfinite) for m in history) > 20
    for leaf in jax.tree.leaves(comparable((state, history))):
        if leaf.dtype.kind == "f":
            assert np.all(np.isfinite(leaf))
    for starts in (state.starts, state.method.seeds, state.method.replay):
        assert np.asarray(starts.qpos)[np.asarray(starts.valid), 0].max() <= 0.1
        assert starts.count() > 0
    # Their episodes count as failures: what is left of the others cannot make up for them.
    assert history[0].success < 1.0
    assert history[0].episodes > 0


# ------------------------------------------------------------------------------------------------- configurations


def test_uniform_with_learned_std_and_raw_observations(line: Line) -> None:
    """The settings that the other tests leave at their other values."""
    policy = dataclasses.replace(CONFIG.policy, learn_std=True, init_std=0.8, obs_norm_iterations=0)
    config = dataclasses.replace(CONFIG, method="uniform", policy=policy)
    state = init_train_state(config, line, 0)
    assert float(jnp.exp(state.agent.policy.log_std[0])) == pytest.approx(0.8)
    state, history = train(compiled(config, line), state, 2)
    assert history[-1].kl > 0
    assert abs(float(history[-1].policy_std) - 0.8) > 1e-4
    assert_identical(state.agent.norm, ObsNormalizer.init(line.obs_dim))
    feasible = np.asarray(line.feasible_starts().qpos)[:, 0]
    assert np.all(state.starts.valid)
    assert np.all(np.isin(np.asarray(state.starts.qpos)[:, 0], feasible))


def test_an_episode_must_fit(line: Line) -> None:
    """Refused when the step is made, before anything compiles; the message says what would do."""
    assert line.horizon == 40
    for envs, length in ((76, 13), (100, 10)):
        rollout = RolloutConfig(num_envs=envs, batch_size=envs * length)
        with pytest.raises(ConfigError, match=rf"rollout.num_envs={envs}: must be <= .* = {3 * length} steps") as error:
            make_train_step(dataclasses.replace(CONFIG, rollout=rollout), line)
        assert "\n" not in str(error.value)
        limit = int(str(error.value).split("must be <= ")[1].split(",")[0])
        assert limit == 3 * envs * length // 40
    # The last of 3 x 14 steps is the earliest that an episode of 40 can need.
    fits = RolloutConfig(num_envs=70, batch_size=70 * 14)
    make_train_step(dataclasses.replace(CONFIG, rollout=fits), line)


def test_sizes_of_whole_episodes_leave_room_for_three_horizons() -> None:
    config = Config(rollout=RolloutConfig(batch="episodes", batch_size=50_000))
    # Of 33 that would do, the most that divide the steps.
    assert with_sizes(config, 500).rollout.num_envs == 25
    with pytest.raises(ConfigError, match=r"rollout\.num_envs=125: must be <= 100, .* hold one episode of 500 steps"):
        with_sizes(dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_envs=125)), 500)


@pytest.mark.parametrize(
    ("settings", "horizon", "share", "found"),
    [
        # Open: 40 horizons, at least 20,000 steps; environments that divide the steps and leave room for 2 horizons.
        ({}, 40, 1, (20_000, 400)),
        ({}, 500, 1, (20_000, 100)),
        ({}, 2_000, 1, (80_000, 100)),
        ({"batch_size": 50_000}, 500, 1, (50_000, 250)),
        ({"batch_size": 50_000}, 2_000, 1, (50_000, 50)),
        ({"num_envs": 50, "batch_size": 40_000}, 500, 1, (40_000, 50)),
        ({}, 500, 4, (20_000, 100)),
        ({}, 500, 8, (20_000, 80)),
        ({}, 2_000, 64, (80_000, 64)),
        ({}, 500, 3, (20_097, 99)),  # 3 does not divide 20,000
        ({"batch_size": 50_000}, 500, 4, (50_000, 200)),
        ({"batch_size": 50_000}, 500, 3, (50_000, 250)),  # left to be refused: the steps are set
        ({"num_envs": 50}, 500, 4, (20_000, 50)),  # so are the environments
        ({}, 500, 101, (20_000, 100)),  # fewer than two horizons would be left
    ],
)
def test_sizes_that_are_set_stay_and_open_ones_suit_horizon_and_devices(
    settings: dict[str, int], horizon: int, share: int, found: tuple[int, int]
) -> None:
    config = with_sizes(Config(rollout=RolloutConfig(**settings)), horizon, share)
    assert (config.rollout.batch_size, config.rollout.num_envs) == found
    assert with_sizes(config, horizon, share) == config, "once more changes nothing"
    make_train_step(config, Line(horizon=horizon))


def test_environments_must_divide_the_batch_that_the_horizon_gives() -> None:
    config = Config(rollout=RolloutConfig(num_envs=300))
    with pytest.raises(ConfigError, match=r"rollout\.num_envs=300: .*must divide .* 20000 for horizon 40"):
        make_train_step(config, Line(horizon=40))
    config = Config(rollout=RolloutConfig(num_envs=100, batch_size=1_000), policy=PolicyConfig(action_repeat=4))
    with pytest.raises(ConfigError, match=r"num_envs=100: times policy\.action_repeat=4 must divide .* 1000"):
        make_train_step(config, Line(horizon=40))


@pytest.mark.slow
def test_ppo_learns_too_and_skips_what_does_not_count(line: Line) -> None:
    """In segments, and in whole episodes, whose batches have rows that belong to none."""
    evaluate = jit(make_evaluate(make_policy(CONFIG, line.action_dim), line, 200))
    ppo = PpoConfig(minibatch_size=200, learning_rate=5e-3, epochs=5)
    for rollout in (CONFIG.rollout, RolloutConfig(num_envs=20, batch_size=1_000, batch="episodes")):
        config = dataclasses.replace(CONFIG, algorithm="ppo", ppo=ppo, rollout=rollout)
        state, history = train(compiled(config, line), init_train_state(config, line, 0), 12)
        assert evaluate(state.agent.actor, jax.random.key(5)).successes_stochastic > 0.9 * 200
        assert all(0 < m.kl < 0.2 for m in history)
        assert len(jax.tree.leaves(state.agent.optimizer)) > 2
    assert init_train_state(CONFIG, line, 0).agent.optimizer is None
