"""PPO's update against one written in NumPy, and what its clipping, masks and early stop are for."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rcg_jax.config.settings import PpoConfig
from rcg_jax.rl.policy import GaussianPolicy
from rcg_jax.rl.ppo import clipped_surrogate, ppo_optimizer, ppo_step

POLICY = GaussianPolicy(2, hidden=[], learn_std=True, output_gain=0.5)
CONFIG = PpoConfig(clip=0.2, epochs=3, minibatch_size=16, learning_rate=0.02, entropy=0.01, target_kl=0.0)


def problem(num: int = 40) -> tuple[Any, ...]:
    """Parameters and a batch of a linear policy."""
    rng = np.random.default_rng(0)
    params = POLICY.init(jax.random.key(0), 3, 0.7)
    obs, action = rng.normal(size=(num, 3)), 1.5 * rng.normal(size=(num, 2))
    return params, *(jnp.asarray(x, jnp.float32) for x in (obs, action, rng.normal(size=num)))


def update(config: PpoConfig = CONFIG, batch: Any = None, **kwargs: Any) -> Any:
    params, obs, action, advantage = problem() if batch is None else batch
    kwargs = {"minibatch": config.minibatch_size, "saturation_penalty": 0.3, **kwargs}
    opt_state = ppo_optimizer(config).init(params)
    return ppo_step(POLICY, params, opt_state, obs=obs, action=action, advantage=advantage, config=config, **kwargs)


def reference(config: PpoConfig) -> np.ndarray:
    """The same in NumPy: numerical gradients of the loss, and Adam from its paper."""
    params, *batch = problem()
    flat, unravel = ravel_pytree(params)
    obs, action, advantage = (np.asarray(x, float) for x in batch)

    def outputs(theta: np.ndarray, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        one = unravel(jnp.asarray(theta, jnp.float32))
        names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(one)]
        sizes = np.cumsum([leaf.size for leaf in jax.tree.leaves(one)])[:-1]
        parts = dict(zip(names, np.split(theta, sizes), strict=True))
        kernel = next(v for k, v in parts.items() if "kernel" in k).reshape(3, 2)
        bias = next(v for k, v in parts.items() if "bias" in k)
        return obs @ kernel + bias, parts[".log_std"]

    def log_prob(theta: np.ndarray, obs: np.ndarray, action: np.ndarray) -> np.ndarray:
        mean, log_std = outputs(theta, obs)
        return np.sum(-0.5 * ((action - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi), axis=1)

    theta = np.asarray(flat, float)
    before = log_prob(theta, obs, action)

    def loss(theta: np.ndarray, rows: slice) -> float:
        ratio = np.exp(log_prob(theta, obs[rows], action[rows]) - before[rows])
        gain = np.minimum(ratio * advantage[rows], np.clip(ratio, 0.8, 1.2) * advantage[rows]).mean()
        mean, log_std = outputs(theta, obs[rows])
        beyond = (np.maximum(np.abs(mean) - 1, 0) ** 2).sum(axis=1).mean()
        return 0.3 * beyond - gain - config.entropy * np.sum(log_std + 0.5 * np.log(2 * np.pi * np.e))

    m, v, t = np.zeros_like(theta), np.zeros_like(theta), 0
    for _ in range(config.epochs):
        for begin in (0, 16):
            rows = slice(begin, begin + 16)
            steps = 1e-5 * np.eye(len(theta))
            grad = np.array([(loss(theta + e, rows) - loss(theta - e, rows)) / 2e-5 for e in steps])
            grad *= min(1.0, config.max_grad_norm / np.linalg.norm(grad))
            t += 1
            m, v = 0.9 * m + 0.1 * grad, 0.999 * v + 0.001 * grad**2
            theta = theta - config.learning_rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-5)
    return theta


def test_an_update_is_that_of_numpy() -> None:
    params, _, stats = update()
    np.testing.assert_allclose(ravel_pytree(params)[0], reference(CONFIG), atol=2e-4)
    assert int(stats.attempts) == 6
    assert bool(stats.accepted)


def test_the_surrogate_has_no_slope_where_the_ratio_has_left() -> None:
    slope = jax.vmap(jax.grad(clipped_surrogate), (0, 0, None))
    ratio, advantage = jnp.array([0.7, 0.7, 1.3, 1.3, 1.0]), jnp.array([1.0, -1.0, 1.0, -1.0, 2.0])
    np.testing.assert_allclose(slope(ratio, advantage, 0.2), [1.0, 0.0, 0.0, -1.0, 2.0])


def test_samples_that_do_not_count_change_nothing() -> None:
    params, obs, action, advantage = problem(48)
    expected = update(batch=(params, obs[:32], action[:32], advantage[:32]))
    junk = jnp.where(jnp.arange(48) < 40, advantage, jnp.nan)
    found = update(batch=(params, obs, action, junk), count=jnp.int32(40))
    # Samples 32 to 39 fill no minibatch, but belong to the batch that KL and gain are means of.
    np.testing.assert_allclose(ravel_pytree(found[0])[0], ravel_pytree(expected[0])[0], atol=1e-6)
    assert np.isfinite(found[2].kl)
    assert np.isfinite(found[2].gain)


def test_epochs_end_when_the_policy_has_moved_too_far() -> None:
    config = dataclasses.replace(CONFIG, epochs=30, learning_rate=0.05)
    free, bounded = update(config)[2], update(dataclasses.replace(config, target_kl=0.02))[2]
    assert int(free.attempts) == 60
    assert int(bounded.attempts) < 30
    assert not bool(bounded.accepted)
    assert float(bounded.kl) < float(free.kl)
