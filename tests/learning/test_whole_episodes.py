"""rollout.batch=episodes: batches of whole episodes, as the paper's software collects them."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jax.flatten_util import ravel_pytree

from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.physics.jit import jit
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, init_agent
from rcg_jax.rl.rollout import Sampler, Transition, begin, label_starts, whole_episodes
from rcg_jax.rl.train_policy import Batch, make_trpo_iteration, standardized, update_agent
from rcg_jax.train_step import init_train_state, make_train_step
from rcg_jax.types import StartSet
from tests.analytic import Coin, ExactLine, Line, make_starts
from tests.line_run import line_config

GAMMA = 0.9


def toss(obs: Array, noise: Array) -> Array:
    return noise


def to_numpy(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)


COIN = Coin([0.01, 0.05, 0.2, 0.5], failure=0.02, nonfinite=0.01, horizon=20)
STARTS = COIN.starts(valid=[True, True, True, False])
LENGTH, ENVS = 45, 60


@pytest.fixture(scope="module")
def batch() -> Transition:
    collect = jax.jit(partial(whole_episodes, Sampler(COIN, toss), num_envs=ENVS, length=LENGTH))
    return to_numpy(collect(jax.random.key(0), STARTS))


def test_every_environment_gives_whole_episodes_begun_in_time(batch: Transition) -> None:
    """From the first action on, one complete episode after the other, the last begun before row LENGTH."""
    rows = LENGTH - 1 + COIN.horizon
    assert batch.done.shape == (rows, ENVS)
    ended_late = 0
    for n in range(ENVS):
        part = batch.counted[:, n]
        last = int(part.sum()) - 1
        assert part[: last + 1].all()
        assert batch.done[last, n]
        ends = np.flatnonzero(batch.done[: last + 1, n])
        begins = np.concatenate([[0], ends[:-1] + 1])
        assert begins.max() < LENGTH <= last + 1  # no gap, and the next would have begun too late
        ended_late += last >= LENGTH
        ages = np.concatenate([np.arange(1, e - b + 2) for b, e in zip(begins, ends, strict=True)])
        np.testing.assert_array_equal(batch.age[: last + 1, n], ages)
        for b, e in zip(begins, ends, strict=True):
            assert len(set(batch.start[b : e + 1, n])) == 1
    assert ended_late > ENVS / 3
    assert batch.counted.sum() >= LENGTH * ENVS
    assert batch.counted.sum() < batch.counted.size


def test_returns_are_those_of_the_own_episode() -> None:
    """Discounted reward to the episode's end; nothing after T, after a failure, or from V, whatever V says."""
    task = Line(horizon=12, gain=0.1, goal_radius=0.05, fail_above=0.9)
    starts = make_starts([[0.3, 0, 0], [-0.5, 0, 0], [0.75, 0, 0]])
    got = whole_episodes(Sampler(task, toss), jax.random.key(1), starts, num_envs=200, length=30)
    value = jax.random.normal(jax.random.key(2), got.reward.shape)
    next_value = 100.0 * jnp.ones_like(value)
    # With lambda 1 the values within an episode cancel; those after its end must not come in.
    after = jnp.concatenate([value[1:], value[:1]])
    next_value = jnp.where(got.done, next_value, after)
    advantage, target = generalized_advantage(got.reward, value, next_value, got.done, got.done, gamma=GAMMA, lam=1.0)
    got, target, advantage, value = to_numpy((got, target, advantage, value))
    kinds = {"goal": 0, "failure": 0, "time": 0}
    for n in range(200):
        begun = 0
        for t in np.flatnonzero(got.done[:, n] & got.counted[:, n]):
            reached = bool(got.success[t, n])
            kinds["goal" if reached else "failure" if got.terminal[t, n] else "time"] += 1
            wanted = GAMMA ** np.arange(t - begun, -1, -1) * reached
            np.testing.assert_allclose(target[begun : t + 1, n], wanted, atol=2e-5)
            np.testing.assert_allclose(advantage[begun : t + 1, n], wanted - value[begun : t + 1, n], atol=2e-5)
            assert t - begun < task.horizon
            begun = t + 1
    assert min(kinds.values()) > 20


def test_success_rate_is_unbiased_where_short_episodes_succeed() -> None:
    """Successes end early, failures take T: whoever keeps only what is complete after a fixed time counts too many."""
    task = Coin([0.02, 0.05], horizon=40)
    starts = task.starts()
    collect = jax.jit(partial(whole_episodes, Sampler(task, toss), num_envs=4_000, length=60))
    got = collect(jax.random.key(3), starts)
    labels = to_numpy(label_starts(got, 2))
    naive = to_numpy(label_starts(dataclasses.replace(jax.tree.map(lambda x: x[:60], got)), 2))
    for i, p in enumerate(task.success_probability):
        n = labels.episodes[i]
        sigma = np.sqrt(p * (1 - p) / n)
        assert abs(labels.successes[i] / n - p) < 4 * sigma
        assert naive.successes[i] / naive.episodes[i] - p > 6 * sigma


def test_the_success_of_small_batches_is_unbiased_on_average() -> None:
    """Successes of a batch minus p times its episodes is zero on average (Wald), also for few environments."""
    task = Coin([0.05], horizon=20)
    starts = task.starts()
    collect = jax.jit(jax.vmap(lambda key: whole_episodes(Sampler(task, toss), key, starts, num_envs=2, length=30)))
    got = collect(jax.random.split(jax.random.key(4), 3_000))
    labels = to_numpy(jax.vmap(lambda b: label_starts(b, 1))(got))
    p = task.success_probability[0]
    excess = labels.successes[:, 0] - p * labels.episodes[:, 0]
    assert abs(excess.mean()) < 4 * excess.std() / np.sqrt(len(excess))


def test_seeds_side_by_side_are_as_alone(batch: Transition) -> None:
    """A seed that is done waits for the others in the same loop; nothing of its batch may change."""
    keys = jax.random.split(jax.random.key(5), 3).at[1].set(jax.random.key(0))
    collect = partial(whole_episodes, Sampler(COIN, toss), num_envs=ENVS, length=LENGTH)
    together = to_numpy(jax.jit(jax.vmap(collect, (0, None)))(keys, STARTS))
    np.testing.assert_array_equal(together.counted[1], batch.counted)
    for name in Transition.__dataclass_fields__:
        a, b = getattr(together, name)[1], getattr(batch, name)
        np.testing.assert_array_equal(a[batch.counted], b[batch.counted])


@pytest.mark.slow
def test_masked_samples_have_no_part_in_an_improvement() -> None:
    """The same agent from a batch alone and from the same batch with rubbish behind it."""
    config = line_config("trpo.fisher_fraction=1.0", "trpo.saturation_penalty=0.3", "policy.learn_std=true")
    agent = init_agent(config, jax.random.key(0), 2, 1)
    num, more = 600, 250
    keys = jax.random.split(jax.random.key(1), 4)
    obs, action = jax.random.normal(keys[0], (num, 2)), 2.0 * jax.random.normal(keys[1], (num, 1))
    reward = jax.random.normal(keys[2], (num,)) + obs[:, 0] * action[:, 0]
    target = jax.random.normal(keys[3], (num,))
    learn = jnp.bool_(True)
    batch = Batch(obs, action, standardized(reward), target)
    alone, stats = jit(lambda: update_agent(config, agent, batch, learn_norm=learn))()

    def padded(x: Array) -> Array:
        return jnp.concatenate([x, jnp.full((more, *x.shape[1:]), 7.0)])

    mask = jnp.arange(num + more) < num
    advantage = standardized(padded(reward), mask)
    np.testing.assert_allclose(advantage[:num], standardized(reward), atol=1e-5)
    longer = Batch(padded(obs), padded(action), advantage, padded(target), count=jnp.int32(num))
    both, padded_stats = jit(lambda: update_agent(config, agent, longer, learn_norm=learn, least=num))()
    for name in ("gain", "kl"):
        np.testing.assert_allclose(getattr(padded_stats, name), getattr(stats, name), rtol=2e-3)
    for part in ("policy", "baseline", "norm"):
        a, b = ravel_pytree(getattr(alone, part))[0], ravel_pytree(getattr(both, part))[0]
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4)


def episodes_config(*more: str) -> Config:
    return line_config("rollout.batch=episodes", "rollout.num_envs=10", "rollout.batch_size=1000", *more)


def iterate(config: Config, task: Line, agent: Agent, starts: StartSet, *, seed: int = 0, remaining: int = 0) -> Any:
    """(agent, what it learned from) after one TRPO iteration; the seed is that of the environments handed in."""
    iteration = jit(make_trpo_iteration(config, task))
    env = begin(task, jax.random.key(seed), starts, config.rollout.num_envs)
    settings = {"remaining": jnp.int32(remaining), "learn_norm": jnp.bool_(False), "max_kl": jnp.float32(0.01)}
    after, _, shown = iteration(jax.random.key(3), agent, env, starts, **settings)
    return after, shown


def test_a_trpo_iteration_begins_afresh_and_trains_on_all_it_counts() -> None:
    """V's error is that of the returns; the environments handed in play no part."""
    config, task = episodes_config("trpo.gae_lambda=1.0"), Line(horizon=40)
    agent = init_agent(config, jax.random.key(0), 2, 1)
    starts = make_starts([[0.2, 0, 0], [0.6, 0, 0]])
    shown = []
    for seed in (0, 1):
        after, one = iterate(config, task, agent, starts, seed=seed)
        shown.append((ravel_pytree(after.policy)[0], one))
    np.testing.assert_array_equal(shown[0][0], shown[1][0])
    one = shown[0][1]
    assert int(one.labels.episodes.sum()) >= 1000 // 40
    assert 1000 <= int(one.env_steps) <= 1000 + 10 * 39
    assert int(one.env_steps) % 10 == 0
    assert 0 < float(one.trpo.kl) <= 0.01
    assert 0 < float(one.value_error) < 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "repeat"), [("reverse", 2), ("all_starts", 1), ("uniform", 1), ("oracle", 1), ("self_play", 1)]
)
def test_every_method_learns_from_whole_episodes(method: str, repeat: int) -> None:
    config = episodes_config(f"method={method}", f"policy.action_repeat={repeat}", "trpo.iterations=2")
    task = ExactLine(horizon=40, gain=0.05)
    state = init_train_state(config, task, 0)
    step = jit(make_train_step(config, task))
    metrics = []
    for _ in range(12):
        state, one = step(state)
        metrics.append(to_numpy(one))
    steps = [int(m.env_steps) for m in metrics]
    assert all(2_000 <= s <= 2 * (1_000 + 10 * 40) for s in steps)
    assert all(m.episodes >= 2_000 // 40 for m in metrics)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(to_numpy(state.agent)))
    assert metrics[-1].success > metrics[0].success or metrics[-1].success > 0.9


def test_nothing_follows_a_segment_episode_that_ran_out_of_time() -> None:
    """rollout.value_at_horizon=false: V is followed at cuts only. The difference is what V says at T."""
    task = Line(horizon=10, gain=0.01)
    starts = make_starts([[0.9, 0, 0]])  # out of reach: every episode ends by time
    errors = {}
    for on in (True, False):
        config = line_config("trpo.gae_lambda=1.0", "rollout.num_envs=40", "rollout.batch_size=400")
        config = dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, value_at_horizon=on))
        agent = init_agent(config, jax.random.key(0), 2, 1)
        out = dataclasses.replace(agent.baseline, params=jax.tree.map(jnp.zeros_like, agent.baseline.params))
        out.params["params"]["Dense_1"]["bias"] = jnp.ones(1)  # V = 1 everywhere
        agent = dataclasses.replace(agent, baseline=out)
        _, shown = iterate(config, task, agent, starts, remaining=400)
        errors[on] = float(shown.value_error)
    gamma = line_config().trpo.gamma
    left = np.arange(10, 0, -1)
    np.testing.assert_allclose(errors[True], np.sqrt(np.mean((gamma**left - 1) ** 2)), rtol=1e-3)
    np.testing.assert_allclose(errors[False], 1.0, rtol=1e-3)


def test_more_environments_than_the_batch_has_horizons_are_refused() -> None:
    """Each would have one episode, and the batch more steps than asked for."""
    task, words = Line(horizon=40), ("rollout.batch_size=1000", "trpo.iterations=1")
    make_train_step(episodes_config("rollout.num_envs=25", *words), task)
    with pytest.raises(ConfigError, match=r"rollout\.num_envs=50: must be <= 25, "):
        make_train_step(episodes_config("rollout.num_envs=50", *words), task)


def test_v_is_fitted_however_large_its_minibatches_are() -> None:
    """Of padded batches, too: there are fewer samples than rows, and one minibatch has to fit into them."""
    config, task = episodes_config(), Line(horizon=40)
    config = dataclasses.replace(config, baseline=dataclasses.replace(config.baseline, minibatch_size=1_000_000))
    agent = init_agent(config, jax.random.key(0), 2, 1)
    starts = make_starts([[0.2, 0, 0], [0.6, 0, 0]])
    after, _ = iterate(config, task, agent, starts)
    moved = ravel_pytree(after.baseline.params)[0] - ravel_pytree(agent.baseline.params)[0]
    assert float(jnp.abs(moved).max()) > 1e-3
