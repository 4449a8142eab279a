"""Advantages, conjugate gradients, Fisher products, line search, TRPO, policy, observation statistics, baseline."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import integrate, stats

from rcg_jax.config.settings import TrpoConfig
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.baseline import Baseline
from rcg_jax.rl.conjugate_gradient import conjugate_gradient
from rcg_jax.rl.line_search import backtracking_line_search
from rcg_jax.rl.policy import Gaussian, GaussianPolicy, ObsNormalizer, PolicyParams
from rcg_jax.rl.trpo import fisher_product, trpo_step, trust_region_radius
from rcg_jax.types import StartLabels

# ---------------------------------------------------------------------------------------------------- advantages


def episodes(seed: int, length: int = 40, num_envs: int = 7) -> dict[str, np.ndarray]:
    """Random steps with terminal ends, ends at the horizon, and episodes cut off by the end of the segment."""
    rng = np.random.default_rng(seed)
    shape = (length, num_envs)
    done = rng.random(shape) < 0.15
    terminal = done & (rng.random(shape) < 0.5)
    value = rng.normal(size=shape)
    # V(s_{t+1}) is the next row's V(s_t), except where the next row belongs to another episode.
    next_value = np.concatenate([value[1:], rng.normal(size=(1, num_envs))])
    next_value = np.where(done, rng.normal(size=shape), next_value)
    return {
        "reward": rng.normal(size=shape),
        "value": value,
        "next_value": next_value,
        "terminal": terminal,
        "done": done,
    }


def mean_of_n_step_advantages(
    reward: np.ndarray,
    value: np.ndarray,
    next_value: np.ndarray,
    terminal: np.ndarray,
    done: np.ndarray,
    gamma: float,
    lam: float,
) -> np.ndarray:
    """The definition of GAE: (1 - lambda) sum_n lambda^(n-1) A^(n), the longest A^(n) takes the rest of the weight."""
    out = np.zeros_like(reward)
    for env in range(reward.shape[1]):
        for t in range(len(reward)):
            n_step, discounted = [], 0.0
            for k in range(t, len(reward)):
                n = k - t + 1
                discounted += gamma ** (n - 1) * reward[k, env]
                bootstrap = 0.0 if terminal[k, env] else gamma**n * next_value[k, env]
                n_step.append(discounted + bootstrap - value[t, env])
                if done[k, env]:
                    break
            weights = [(1 - lam) * lam**i for i in range(len(n_step) - 1)] + [lam ** (len(n_step) - 1)]
            out[t, env] = np.dot(weights, n_step)
    return out


@pytest.mark.parametrize("lam", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_advantage_is_the_mean_of_n_step_advantages(lam: float, gamma: float) -> None:
    data = episodes(seed=0)
    assert (data["done"] & ~data["terminal"]).any()
    assert data["terminal"].any()
    assert not data["done"][-1].all()
    advantage, target = generalized_advantage(**{k: jnp.asarray(v) for k, v in data.items()}, gamma=gamma, lam=lam)
    np.testing.assert_allclose(advantage, mean_of_n_step_advantages(**data, gamma=gamma, lam=lam), atol=2e-5)
    np.testing.assert_allclose(target, np.asarray(advantage) + data["value"], atol=1e-6)


# -------------------------------------------------------------------------------------------- conjugate gradients


def spd_matrix(seed: int, size: int, condition: float = 50.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return (q * np.geomspace(1.0, condition, size)) @ q.T


@pytest.mark.parametrize(("dtype", "rtol"), [(jnp.float32, 2e-4), (jnp.float64, 1e-6)])
def test_conjugate_gradient_solves(dtype: Any, rtol: float) -> None:
    with jax.enable_x64(dtype == jnp.float64):
        for seed in range(5):
            a = spd_matrix(seed, 15)
            b = np.random.default_rng(seed).normal(size=15)
            product = functools.partial(jnp.matmul, jnp.asarray(a, dtype))
            x = conjugate_gradient(product, jnp.asarray(b, dtype), iterations=30)
            assert x.dtype == dtype
            expected = np.linalg.solve(a, b)
            assert np.linalg.norm(np.asarray(x) - expected) < rtol * np.linalg.norm(expected)


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_conjugate_gradient_is_optimal_in_its_krylov_space(iterations: int) -> None:
    """After k products x is the minimiser of the quadratic in span(b, A b, ..., A^(k-1) b); that is what CG is."""
    a = spd_matrix(3, 12)
    b = np.random.default_rng(3).normal(size=12)
    krylov = np.linalg.qr(np.stack([np.linalg.matrix_power(a, i) @ b for i in range(iterations)], axis=1))[0]
    expected = krylov @ np.linalg.solve(krylov.T @ a @ krylov, krylov.T @ b)
    matrix = jnp.asarray(a, jnp.float32)
    x = conjugate_gradient(lambda v: matrix @ v, jnp.asarray(b, jnp.float32), iterations=iterations)
    np.testing.assert_allclose(x, expected, atol=1e-4 * np.abs(expected).max())


def test_conjugate_gradient_of_zero_and_of_nan_is_zero() -> None:
    for b in (jnp.zeros(4), jnp.full(4, jnp.nan)):
        np.testing.assert_array_equal(conjugate_gradient(lambda v: 2.0 * v, b, iterations=10), np.zeros(4))


def test_conjugate_gradient_stops_when_solved() -> None:
    """Far more iterations than needed must not divide by a vanished residual."""
    x = conjugate_gradient(lambda v: 4.0 * v, jnp.ones(3), iterations=1000)
    np.testing.assert_allclose(x, np.full(3, 0.25))


# ------------------------------------------------------------------------------------------- policy, Fisher matrix


OBS_DIM, ACTION_DIM = 3, 2


def make_policy(seed: int = 0, *, learn_std: bool = False, hidden: int = 4) -> tuple[GaussianPolicy, PolicyParams]:
    """A small policy somewhere in parameter space, with a different standard deviation in each dimension."""
    policy = GaussianPolicy(ACTION_DIM, hidden=[hidden], learn_std=learn_std, output_gain=1.0)
    params = policy.init(jax.random.key(seed), OBS_DIM)
    return policy, dataclasses.replace(params, log_std=jnp.log(jnp.array([0.5, 1.7])))


def random_gaussians(seed: int) -> tuple[Gaussian, Gaussian]:
    rng = np.random.default_rng(seed)

    def one() -> Gaussian:
        return Gaussian(mean=jnp.asarray(rng.normal(size=(4, 3))), log_std=jnp.asarray(rng.uniform(-1, 1, size=3)))

    return one(), one()


def test_log_prob_and_entropy_match_scipy() -> None:
    dist, other = random_gaussians(0)
    action = np.asarray(other.mean)
    mean, std = np.asarray(dist.mean), np.exp(np.asarray(dist.log_std))
    np.testing.assert_allclose(dist.log_prob(other.mean), stats.norm.logpdf(action, mean, std).sum(axis=-1), rtol=1e-5)
    np.testing.assert_allclose(dist.entropy(), stats.norm.entropy(0.0, std).sum(), rtol=1e-5)
    noise = np.random.default_rng(1).normal(size=mean.shape)
    np.testing.assert_allclose(dist.sample(jnp.asarray(noise)), mean + std * noise, rtol=1e-5)


def test_kl_matches_numerical_integration() -> None:
    p, q = random_gaussians(1)
    p_std, q_std = np.exp(np.asarray(p.log_std)), np.exp(np.asarray(q.log_std))
    for row, actual in enumerate(np.asarray(p.kl(q))):
        expected = 0.0
        for dim in range(3):  # the dimensions are independent
            a = stats.norm(float(p.mean[row, dim]), p_std[dim])
            b = stats.norm(float(q.mean[row, dim]), q_std[dim])
            low, high = a.mean() - 12 * a.std(), a.mean() + 12 * a.std()
            expected += integrate.quad(lambda x, a=a, b=b: a.pdf(x) * (a.logpdf(x) - b.logpdf(x)), low, high)[0]
        assert actual == pytest.approx(expected, rel=1e-4)
    np.testing.assert_allclose(p.kl(p), np.zeros(4), atol=1e-6)


def hessian_of_kl(policy: GaussianPolicy, params: PolicyParams, obs: jax.Array) -> jax.Array:
    """Hessian (P, P) of the mean KL from ``params``, by differentiating twice."""
    flat, unravel = ravel_pytree(params)
    old = policy(params, obs)
    return jax.jit(jax.hessian(lambda theta: jnp.mean(old.kl(policy(unravel(theta), obs)))))(flat)


def dense_fisher(policy: GaussianPolicy, params: PolicyParams, obs: jax.Array, damping: float) -> jax.Array:
    """The matrix (P, P) behind ``fisher_product``."""
    identity = jnp.eye(ravel_pytree(params)[0].size)
    return jax.jit(lambda p, x: jax.vmap(fisher_product(policy, p, x, damping))(identity))(params, obs)


@pytest.mark.parametrize(("learn_std", "damping"), [(False, 0.3), (True, 0.0), (True, 0.3)])
def test_fisher_product_is_the_hessian_of_the_mean_kl(learn_std: bool, damping: float) -> None:
    policy, params = make_policy(learn_std=learn_std)
    obs = jax.random.normal(jax.random.key(1), (20, OBS_DIM))
    fisher = np.asarray(dense_fisher(policy, params, obs, damping))
    hessian = np.asarray(hessian_of_kl(policy, params, obs))
    np.testing.assert_allclose(fisher, hessian + damping * np.eye(len(fisher)), atol=2e-5)
    np.testing.assert_allclose(fisher, fisher.T, atol=1e-5)
    assert np.linalg.eigvalsh(fisher).min() > damping - 1e-5
    # The standard deviation has curvature exactly where it is learned: 2 per dimension (ravel puts it last).
    is_std = np.asarray(ravel_pytree(jax.tree.map(jnp.zeros_like, params).replace(log_std=jnp.ones(ACTION_DIM)))[0]) > 0
    np.testing.assert_allclose(np.diag(fisher)[is_std], 2.0 * learn_std + damping, atol=1e-5)


# ---------------------------------------------------------------------------------------------------- line search


def test_line_search_takes_the_longest_acceptable_step() -> None:
    """Random quadratic gains and KLs, against a plain loop."""
    max_kl, ratio, max_backtracks = 0.05, 0.7, 8

    def search(slope: jax.Array, bend: jax.Array, curvature: jax.Array) -> Any:
        def evaluate(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            d = theta[0] - 1.0
            return slope * d - bend * d * d, curvature * d * d

        return backtracking_line_search(
            evaluate, jnp.ones(1), jnp.ones(1), max_kl=max_kl, ratio=ratio, max_backtracks=max_backtracks
        )

    rng = np.random.default_rng(0)
    slope, bend, curvature = rng.uniform(-0.5, 2, 300), rng.uniform(-1, 6, 300), 10 ** rng.uniform(-3, 1.5, 300)
    result = jax.jit(jax.vmap(search))(*(jnp.asarray(x, jnp.float32) for x in (slope, bend, curvature)))
    kinds = set()
    for i in range(300):
        steps = ratio ** np.arange(max_backtracks)
        gain, kl = slope[i] * steps - bend[i] * steps**2, curvature[i] * steps**2
        ok = np.flatnonzero((gain > 0) & (kl <= max_kl))
        assert bool(result.accepted[i]) == bool(ok.size)
        if ok.size:
            k = ok[0]
            assert result.attempts[i] == k + 1
            np.testing.assert_allclose(result.params[i], 1 + steps[k], rtol=1e-5)
            np.testing.assert_allclose([result.gain[i], result.kl[i]], [gain[k], kl[k]], rtol=1e-3, atol=1e-6)
            assert result.kl[i] <= max_kl
            assert result.gain[i] > 0
        else:
            assert result.attempts[i] == max_backtracks
            assert result.params[i] == 1.0
            assert result.gain[i] == 0.0
            assert result.kl[i] == 0.0
        kinds.add(int(ok[0]) if ok.size else -1)
    assert {-1, 0, 1, 5} <= kinds  # the cases were there


@pytest.mark.parametrize(
    ("gain", "kl"), [(np.nan, 0.0), (np.inf, 0.0), (1.0, np.nan), (0.0, 0.0), (-1.0, 0.0), (1.0, 2.0)]
)
def test_line_search_rejects(gain: float, kl: float) -> None:
    """Non-finite, not better, or too far: nothing moves."""
    params = jnp.array([0.1, -3.0])
    result = backtracking_line_search(
        lambda theta: (jnp.float32(gain), jnp.float32(kl)), params, jnp.ones(2), max_kl=1.0, ratio=0.5, max_backtracks=6
    )
    assert not result.accepted
    assert result.attempts == 6
    np.testing.assert_array_equal(result.params, params)


def test_line_search_accepts_after_nan() -> None:
    """A step so long that it overflows is shortened like any other."""

    def evaluate(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.where(theta[0] > 0.3, jnp.nan, theta[0]), jnp.abs(theta[0])

    result = backtracking_line_search(evaluate, jnp.zeros(1), jnp.ones(1), max_kl=1.0, ratio=0.5, max_backtracks=6)
    assert result.accepted
    assert result.attempts == 3
    np.testing.assert_allclose(result.params, [0.25])


# ----------------------------------------------------------------------------------------------------------- TRPO


def surrogate(old: Gaussian, new: Gaussian, action: Any, advantage: Any) -> np.ndarray:
    """Importance-weighted mean advantage (...,) of batches (..., B), from scipy's densities."""

    def density(dist: Gaussian) -> np.ndarray:
        std = np.exp(np.asarray(dist.log_std, float))[..., None, :]
        return stats.norm.pdf(np.asarray(action, float), np.asarray(dist.mean, float), std).prod(-1)

    return np.mean(density(new) / density(old) * np.asarray(advantage, float), axis=-1)


def test_trpo_step_improves_the_surrogate_within_the_bound() -> None:
    """Property over random policies and batches; also where the Fisher sample is a bad one."""
    policy = make_policy(learn_std=True)[0]
    config = TrpoConfig(max_kl=0.02, max_backtracks=12, cg_damping=1e-3)

    def one(key: jax.Array, shrink: jax.Array) -> tuple[Any, ...]:
        keys = jax.random.split(key, 4)
        params = policy.init(keys[0], OBS_DIM)
        obs = 2.0 * jax.random.normal(keys[1], (200, OBS_DIM))
        old = policy(params, obs)
        action = old.sample(jax.random.normal(keys[2], old.mean.shape))
        advantage = jnp.sin(3 * action[:, 0]) + obs[:, 0] * action[:, 1] + jax.random.normal(keys[3], (200,))
        # 40 of 200 states, drawn towards 0 where the mean hardly reacts: the step comes out too long
        after, info = trpo_step(
            policy,
            params,
            obs,
            action,
            advantage,
            fisher_obs=shrink * obs[:40],
            scale_obs=shrink * obs[:40],
            config=config,
        )
        new = policy(after, obs)
        return params, after, info, old, new, action, advantage

    shrink = jnp.repeat(jnp.array([1.0, 0.4]), 20)
    keys = jax.random.split(jax.random.key(7), 40)
    params, after, info, old, new, action, advantage = jax.jit(jax.vmap(one))(keys, shrink)
    kl = np.mean(jax.vmap(lambda p, q: p.kl(q))(old, new), axis=-1)
    assert np.all(info.kl <= config.max_kl)
    np.testing.assert_allclose(info.kl, kl, rtol=1e-3, atol=1e-6)
    excess = [np.maximum(np.abs(np.asarray(dist.mean, float)) - 1, 0) for dist in (old, new)]
    was, is_now = (np.mean(np.sum(each**2, axis=-1), axis=-1) for each in excess)
    assert np.mean(was > 0.01) > 0.5  # the penalty has a part in it
    gain = surrogate(old, new, action, advantage) - surrogate(old, old, action, advantage)
    gain -= config.saturation_penalty * (is_now - was)
    np.testing.assert_allclose(info.gain, gain, rtol=1e-3, atol=1e-5)
    np.testing.assert_array_equal(gain > 0, info.accepted)
    unchanged = jax.vmap(lambda a, b: jnp.all(ravel_pytree(a)[0] == ravel_pytree(b)[0]))(params, after)
    np.testing.assert_array_equal(unchanged, ~info.accepted)
    assert np.all(info.accepted[:20])
    assert np.mean(info.accepted) > 0.8
    assert np.mean(info.attempts[:20]) < np.mean(info.attempts[20:]) - 1  # the bad sample had to be corrected
    assert np.median(kl[:20]) > 0.5 * config.max_kl  # and the good one uses the trust region


@functools.cache
def fixed_batch() -> tuple[Any, ...]:
    """A policy, a batch, and a compiled update of it for given advantages."""
    policy, params = make_policy()
    config = TrpoConfig(max_kl=1e-4, cg_iterations=60, cg_damping=1e-2, step_scale=0.9, saturation_penalty=0.0)
    obs = jax.random.normal(jax.random.key(1), (100, OBS_DIM))
    action = policy(params, obs).sample(jax.random.normal(jax.random.key(2), (100, ACTION_DIM)))
    step = jax.jit(
        lambda advantage: trpo_step(
            policy, params, obs, action, advantage, fisher_obs=obs, scale_obs=obs, config=config
        )
    )
    return policy, params, config, obs, action, step


def test_trpo_step_follows_the_natural_gradient() -> None:
    """A step, up to its backtracking, is sqrt(2 delta / x^T F x) x, with F x = g solved densely."""
    policy, params, config, obs, action, update = fixed_batch()
    advantage = action[:, 0] - obs[:, 1] * action[:, 1]
    after, info = update(advantage)
    assert info.accepted

    flat, unravel = ravel_pytree(params)
    gradient = jax.jit(jax.grad(lambda t: jnp.mean(policy(unravel(t), obs).log_prob(action) * advantage)))(flat)
    fisher = np.asarray(hessian_of_kl(policy, params, obs), float) + config.cg_damping * np.eye(flat.size)
    x = np.linalg.solve(fisher, np.asarray(gradient, float))
    scale = config.step_scale * config.backtrack_ratio ** (int(info.attempts) - 1)
    step = scale * np.sqrt(2 * config.max_kl / (x @ fisher @ x)) * x
    moved = np.asarray(ravel_pytree(after)[0] - flat)
    np.testing.assert_array_equal(after.log_std, params.log_std)
    assert np.linalg.norm(moved - step) < 0.02 * np.linalg.norm(step)


@pytest.mark.parametrize(
    ("successes", "failures", "share"),
    [(0, 0, 1.0), (0, 3, 1.0), (80, 20, 1.0), (98, 2, 0.4), (199, 1, 0.1), (9, 0, 0.1)],
)
def test_the_trust_region_shrinks_with_the_failures(successes: int, failures: int, share: float) -> None:
    count = np.array([0, successes, failures])
    labels = StartLabels(successes=jnp.array([0, successes, 0]), episodes=jnp.asarray(count), steps=jnp.asarray(count))
    for share_of_failures, expected in ((0.05, share * 0.02), (0.0, 0.02)):
        config = TrpoConfig(max_kl=0.02, full_step_failures=share_of_failures)
        np.testing.assert_allclose(trust_region_radius(config, labels), expected, rtol=1e-5)


@pytest.mark.parametrize("advantage", [0.0, np.nan, np.inf])
def test_trpo_step_without_a_usable_advantage_changes_nothing(advantage: float) -> None:
    _, params, _, _, _, update = fixed_batch()
    after, info = update(jnp.zeros(100).at[3].set(advantage))
    jax.tree.map(np.testing.assert_array_equal, after, params)
    assert not info.accepted
    assert info.kl == 0.0
    assert info.gain == 0.0


# ------------------------------------------------------------------------------- observation statistics, baseline


def test_obs_normalizer_equals_statistics_of_everything_seen() -> None:
    rng = np.random.default_rng(0)
    chunks = [
        rng.normal(3.0, 2.0, (5, 4, OBS_DIM)),
        rng.normal(-8.0, 0.1, (1, OBS_DIM)),
        rng.normal(size=(300, OBS_DIM)),
    ]
    norm = ObsNormalizer.init(OBS_DIM)
    for i in range(len(chunks)):
        norm = norm.update(jnp.asarray(chunks[i], jnp.float32))
        seen = np.concatenate([c.reshape(-1, OBS_DIM) for c in chunks[: i + 1]])
        assert norm.count == len(seen)
        np.testing.assert_allclose(norm.mean, seen.mean(axis=0), atol=1e-4)
        np.testing.assert_allclose(norm.var, seen.var(axis=0), rtol=1e-4)
    out = np.asarray(norm(jnp.asarray(seen, jnp.float32)))
    np.testing.assert_allclose(out.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(out.std(axis=0), 1.0, atol=1e-3)


def test_obs_normalizer_is_the_identity_at_first_and_clips() -> None:
    norm = ObsNormalizer.init(OBS_DIM)
    obs = jnp.array([[0.5, -2.0, 9.0]])
    np.testing.assert_allclose(norm(obs), obs, rtol=1e-5)
    np.testing.assert_allclose(norm(jnp.array([1e6, -1e6, 0.0])), [10.0, -10.0, 0.0])
    constant = norm.update(jnp.full((50, OBS_DIM), 4.0))
    np.testing.assert_allclose(constant(jnp.full(OBS_DIM, 4.0)), np.zeros(OBS_DIM))  # no variance, no NaN


def test_baseline_learns_a_function() -> None:
    baseline = Baseline(hidden=[16, 16], epochs=20, minibatch_size=64, learning_rate=3e-3)
    state = baseline.init(jax.random.key(0), OBS_DIM)
    fit = jax.jit(baseline.fit)

    def data(seed: int) -> tuple[jax.Array, jax.Array]:
        obs = jax.random.normal(jax.random.key(seed), (1_000, OBS_DIM))
        return obs, jnp.sin(obs[:, 0]) + 0.5 * obs[:, 1]

    def error(state: Any) -> float:
        obs, target = data(99)  # not what it was fitted to
        value = baseline(state, obs)
        assert value.shape == target.shape
        return float(jnp.mean((value - target) ** 2) / jnp.var(target))

    errors = [error(state)]
    for i in range(3):
        state = fit(state, *data(i))
        errors.append(error(state))
    assert errors[0] > 0.5
    assert errors[1] < 0.2
    assert errors[3] < 0.05


def test_baseline_takes_the_configured_number_of_steps() -> None:
    """Epochs x whole minibatches; a batch smaller than one minibatch is one."""
    for size, steps in ((250, 3 * 2), (60, 3)):
        baseline = Baseline(hidden=[4], epochs=3, minibatch_size=100, learning_rate=1e-3)
        state = baseline.init(jax.random.key(0), OBS_DIM)
        state = baseline.fit(state, jnp.ones((size, OBS_DIM)), jnp.ones(size))
        assert int(state.opt_state[0].count) == steps
