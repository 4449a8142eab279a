"""Observations and distances that leave their domain end an episode as a failure, and nothing of them stays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax.curriculum.settle import settled
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.rl.policy import Actor, GaussianPolicy, ObsNormalizer
from rcg_jax.rl.rollout import Sampler, begin, rollout, whole_episodes
from rcg_jax.types import finite
from tests.analytic import Line, make_starts


class Blind(Line):
    """The policy sees nothing where x > 2: NaN, or what float32 statistics cannot hold."""

    what = jnp.nan

    def observe(self, s):
        return jnp.where(s.qpos[0] > 2.0, self.what, super().observe(s))


class Huge(Blind):
    what = 1e30


def test_finite_replaces_whole_rows():
    obs, seen = finite(jnp.array([[1.0, 2.0], [jnp.nan, 2.0], [1.0, -jnp.inf], [1e11, 0.0]]))
    np.testing.assert_array_equal(seen, [True, False, False, False])
    np.testing.assert_array_equal(obs, [[1, 2], [0, 0], [0, 0], [0, 0]])


@pytest.mark.parametrize("cls", [Blind, Huge])
@pytest.mark.parametrize("whole", [True, False])
def test_a_blind_state_ends_the_episode_as_a_failure(cls, whole):
    """All walk up, from 1.5 or from 2.5; no observation that is learned from is anything but seen or zero."""
    task = cls(gain=0.3)
    starts = make_starts([[x, 0, 0] for x in [1.5, 2.5]])
    sampler = Sampler(task, lambda obs, noise: jnp.full_like(noise, 1.0))
    if whole:
        run = lambda key: whole_episodes(sampler, key, starts, num_envs=8, length=20)  # noqa: E731
    else:
        run = lambda key: rollout(  # noqa: E731
            sampler, key, begin(task, key, starts, 8), starts, length=20, remaining=jnp.int32(1000)
        )[1]
    batch = jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(0)))
    for leaf in (batch.obs, batch.next_obs, batch.reward):
        assert np.isfinite(leaf).all()
        assert (np.abs(leaf) < 1e10).all()
    ended = batch.done & batch.counted
    assert ended.any()
    assert batch.bad[ended].all()
    assert not batch.success.any()
    assert not batch.reward.any()
    assert (batch.age[ended & (batch.start == 1)] == 1).all()  # began where it saw nothing


def test_starts_that_are_not_seen_are_no_starts():
    task = Blind()
    found = settled(task, make_starts([[x, 0, 0] for x in (0.5, 2.5, 1.5)]), 3)
    np.testing.assert_array_equal(found.valid, [True, False, True])


def test_distance_counts_where_it_is_part_of_the_reward():
    class Nowhere(Line):
        def distance(self, s):
            return jnp.where(s.qpos[0] > 2.0, jnp.nan, super().distance(s))

    task = Nowhere(gain=0.3)
    starts = make_starts([[x, 0, 0] for x in [1.5]])
    sampler = Sampler(task, lambda obs, noise: jnp.full_like(noise, 1.0), distance_weight=0.1)
    batch = jax.jit(lambda key: whole_episodes(sampler, key, starts, num_envs=4, length=5))(jax.random.key(0))
    assert np.isfinite(batch.reward).all()
    assert batch.bad[batch.done & batch.counted].all()


def test_evaluation_agrees_with_training_about_a_goal_that_is_not_seen():
    """The episode from 0.1 arrives where nothing is seen, the one from 2.5 begins there: neither is a success."""

    class BlindGoal(Line):
        def observe(self, s):
            return jnp.where((jnp.abs(s.qpos[0]) < 0.05) | (s.qpos[0] > 2.0), jnp.nan, super().observe(s))

    task = BlindGoal()
    policy = GaussianPolicy(1, hidden=[], learn_std=True, output_gain=0.0)
    params = policy.init(jax.random.key(0), 2)
    params.mlp["params"]["Dense_0"]["bias"] = jnp.array([-1.0])
    actor = Actor(policy=params, norm=ObsNormalizer.init(2))
    starts = make_starts([[x, 0, 0] for x in (0.12, 2.5)])
    result = jax.jit(lambda: run_episodes(task, policy, actor, jax.random.key(0), starts, deterministic=True))()
    np.testing.assert_array_equal(result.bad, [True, True])
    assert not result.success.any()
    np.testing.assert_array_equal(result.length, [2, 0])
