"""Trust region policy optimisation (Schulman et al. 2015), the paper's train_pol."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.flatten_util import ravel_pytree

from rcg_jax.config.settings import TrpoConfig
from rcg_jax.rl.conjugate_gradient import conjugate_gradient
from rcg_jax.rl.line_search import backtracking_line_search
from rcg_jax.rl.masked import masked_mean
from rcg_jax.rl.policy import Gaussian, GaussianPolicy, PolicyParams
from rcg_jax.types import StartLabels


@struct.dataclass
class TrpoStats:
    """What one update did: surrogate gain, mean KL [nats], whether a step was accepted, line search attempts."""

    gain: Array
    kl: Array
    accepted: Array
    attempts: Array


def fisher_product(
    policy: GaussianPolicy, params: PolicyParams, obs: Array, damping: float
) -> Callable[[Array], Array]:
    """v -> (F + damping I) v, with F the Fisher matrix of the policy averaged over ``obs`` (B, obs_dim).

    F is the Hessian of mean KL(pi_old || pi) at pi = pi_old. There it equals its Gauss-Newton form J^T H J, with J
    the Jacobian of (mean, log_std) and H = diag(1 / std^2, 2): linearise once, then each product is one forward and
    one backward linear pass.
    """
    flat, unravel = ravel_pytree(params)

    def outputs(theta: Array) -> tuple[Array, Array]:
        dist = policy(unravel(theta), obs)
        return dist.mean, dist.log_std

    (_, log_std), jvp = jax.linearize(outputs, flat)
    vjp = jax.linear_transpose(jvp, flat)
    precision = jnp.exp(-2.0 * log_std) / obs.shape[0]

    def product(v: Array) -> Array:
        d_mean, d_log_std = jvp(v)
        (out,) = vjp((d_mean * precision, 2.0 * d_log_std))
        return out + damping * v

    return product


def saturation(mean: Array, mask: Array | None = None) -> Array:
    """How far mean actions (B, nu) are beyond the actuators' range [-1, 1]: squared excess, mean over the batch, ().

    ``mask`` (B,) says which rows belong to it.

    Actions are clipped to that range. Where full force is best, nothing keeps the mean from growing beyond it without
    end, and once it is several standard deviations outside, every sampled action is the same: exploration is over,
    there and in all states to which the network extends that habit, such as those just behind the frontier.
    """
    excess = jnp.maximum(jnp.abs(mean) - 1.0, 0.0)
    return masked_mean(jnp.sum(excess * excess, axis=-1), mask)


def trust_region_radius(config: TrpoConfig, labels: StartLabels) -> Array:
    """delta of the updates of an iteration [nats], ().

    Advantages are standardised, and a step goes to the boundary of the trust region however little there is to gain.
    Where nearly all episodes succeed, what is left of their differences is mostly noise, and full steps along it wear
    away what was learned about states that training visits rarely. The trust region therefore shrinks in proportion to
    the failures once they are fewer than ``config.full_step_failures`` of the episodes, down to a tenth.

    Args:
        config: TRPO settings.
        labels: outcome of the iteration before. The episodes that end within one batch would not do: environments
            begin together, and as it takes T steps to fail by time, the first batches hold no such failure.
    """
    if not config.full_step_failures:
        return jnp.float32(config.max_kl)
    episodes = jnp.sum(labels.episodes)
    failed = jnp.where(episodes > 0, 1.0 - jnp.sum(labels.successes) / jnp.maximum(episodes, 1), 1.0)
    return config.max_kl * jnp.clip(failed / config.full_step_failures, 0.1, 1.0)


def trpo_step(
    policy: GaussianPolicy,
    params: PolicyParams,
    obs: Array,
    action: Array,
    advantage: Array,
    *,
    fisher_obs: Array,
    scale_obs: Array,
    config: TrpoConfig,
    max_kl: Array | float | None = None,
    mask: Array | None = None,
) -> tuple[PolicyParams, TrpoStats]:
    """One TRPO update.

    Direction: conjugate gradients on Fisher products over ``fisher_obs``, scaled to the trust region's boundary by the
    curvature over ``scale_obs``. Were both the same small sample, the direction would fit that sample's curvature,
    which underestimates that of the batch, and the full step would leave the trust region.
    Acceptance: backtracking on the surrogate and the mean KL of the whole batch. The surrogate includes the penalty
    ``config.saturation_penalty`` times :func:`saturation`.

    Args:
        policy: pi.
        params: its parameters, the old policy.
        obs: (B, obs_dim) normalised observations.
        action: (B, nu) actions as sampled, before clipping.
        advantage: (B,), standardised by the caller.
        fisher_obs: (B', obs_dim), a part of ``obs``.
        scale_obs: (B'', obs_dim), another part of it; with large shares they overlap.
        config: TRPO settings.
        max_kl: (), delta, the trust region of this update [nats]; by default ``config.max_kl``.
        mask: (B,) bool, which rows of the batch count; None: all. The two samples of the Fisher matrix have no others.
    """
    max_kl = config.max_kl if max_kl is None else max_kl
    flat, unravel = ravel_pytree(params)

    def score(theta: Array) -> tuple[Array, Gaussian]:
        # At the old parameters the surrogate's gradient is that of E[A log pi]: the ratio is 1.
        dist = policy(unravel(theta), obs)
        return masked_mean(dist.log_prob(action) * advantage, mask) - penalty(dist), dist

    def penalty(dist: Gaussian) -> Array:
        return config.saturation_penalty * saturation(dist.mean, mask)

    gradient, old = jax.grad(score, has_aux=True)(flat)
    old_log_prob, old_penalty = old.log_prob(action), penalty(old)

    def gain_and_kl(theta: Array) -> tuple[Array, Array]:
        dist = policy(unravel(theta), obs)
        ratio = jnp.exp(dist.log_prob(action) - old_log_prob)
        gain = masked_mean((ratio - 1.0) * advantage, mask) - (penalty(dist) - old_penalty)
        return gain, masked_mean(old.kl(dist), mask)

    product = fisher_product(policy, params, fisher_obs, config.cg_damping)
    direction = conjugate_gradient(product, gradient, iterations=config.cg_iterations)
    curvature = direction @ fisher_product(policy, params, scale_obs, config.cg_damping)(direction)
    # A zero gradient has no direction; the line search then rejects the zero step.
    scale = config.step_scale * jnp.sqrt(2.0 * max_kl / jnp.maximum(curvature, 1e-20))
    result = backtracking_line_search(
        gain_and_kl,
        flat,
        scale * direction,
        max_kl=max_kl,
        ratio=config.backtrack_ratio,
        max_backtracks=config.max_backtracks,
    )
    stats = TrpoStats(gain=result.gain, kl=result.kl, accepted=result.accepted, attempts=result.attempts)
    return unravel(result.params), stats
