"""Proximal policy optimisation (Schulman et al. 2017): another train_pol, which the paper's method allows.

Rollouts, labels, advantages and V are those of TRPO; only the policy's update differs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jax import Array

from rcg_jax.config.settings import PpoConfig
from rcg_jax.rl.masked import masked_mean
from rcg_jax.rl.policy import GaussianPolicy, PolicyParams
from rcg_jax.rl.trpo import TrpoStats, saturation
from rcg_jax.sharding.devices import over_devices


def ppo_optimizer(config: PpoConfig) -> optax.GradientTransformation:
    """Adam with clipped gradients."""
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate, eps=1e-5))


def clipped_surrogate(ratio: Array, advantage: Array, clip: float) -> Array:
    """min(r A, clip(r, 1 - epsilon, 1 + epsilon) A) of each sample: a lower bound of r A that ends where r leaves."""
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def ppo_step(
    policy: GaussianPolicy,
    params: PolicyParams,
    opt_state: optax.OptState,
    *,
    obs: Array,
    action: Array,
    advantage: Array,
    config: PpoConfig,
    saturation_penalty: float,
    minibatch: int,
    count: Array | None = None,
) -> tuple[PolicyParams, optax.OptState, TrpoStats]:
    """One PPO update: passes over the batch in minibatches.

    Args:
        policy: pi.
        params: its parameters, the old policy.
        opt_state: of :func:`ppo_optimizer`.
        obs: (B, obs_dim) normalised observations in random order; what does not fill a last minibatch is left out.
        action: (B, nu) actions as sampled, before clipping.
        advantage: (B,), standardised by the caller.
        config: PPO settings.
        saturation_penalty: weight of :func:`rcg_jax.rl.trpo.saturation`, as in TRPO.
        minibatch: samples of a minibatch (static), at most B and the least value of ``count``.
        count: () int32, only the first so many samples belong to the batch; None: all. Minibatches hold no others.

    Returns:
        Parameters, state of the optimiser, and what the update did: ``attempts`` are gradient steps; ``accepted``
        is whether none of the epochs was cut off by ``target_kl``.
    """
    optimizer = ppo_optimizer(config)
    mask = None if count is None else jnp.arange(len(obs)) < count
    old = policy(params, obs)
    old_log_prob = old.log_prob(action)
    num = len(obs) // minibatch
    full = num if count is None else count // minibatch

    def split(x: Array) -> Array:
        return over_devices(x[: num * minibatch].reshape(num, minibatch, *x.shape[1:]), axis=1)

    batches = jax.tree.map(split, (obs, action, advantage, old_log_prob))

    def loss(params: PolicyParams, obs: Array, action: Array, advantage: Array, before: Array) -> Array:
        dist = policy(params, obs)
        gain = jnp.mean(clipped_surrogate(jnp.exp(dist.log_prob(action) - before), advantage, config.clip))
        return saturation_penalty * saturation(dist.mean) - gain - config.entropy * dist.entropy()

    Carry = tuple[PolicyParams, optax.OptState]

    def step(carry: Carry, x: tuple[Array, tuple[Array, ...]]) -> tuple[Carry, None]:
        params, opt_state = carry
        updates, opt_state = optimizer.update(jax.grad(loss)(params, *x[1]), opt_state)
        after = optax.apply_updates(params, updates), opt_state
        if count is None:
            return after, None
        return jax.tree.map(lambda new, old: jnp.where(x[0] < full, new, old), after, carry), None

    def kl(params: PolicyParams) -> Array:
        return masked_mean(old.kl(policy(params, obs)), mask)

    def epoch(carry: tuple[Carry, Array, Array], _: None) -> tuple[tuple[Carry, Array, Array], None]:
        learned, running, epochs = carry
        after = jax.lax.scan(step, learned, (jnp.arange(num), batches))[0]
        after = jax.tree.map(lambda new, old: jnp.where(running, new, old), after, learned)
        epochs += running
        if config.target_kl:
            running &= kl(after[0]) <= config.target_kl
        return (after, running, epochs), None

    begin = ((params, opt_state), jnp.bool_(True), jnp.int32(0))
    ((params, opt_state), running, epochs), _ = jax.lax.scan(epoch, begin, None, length=config.epochs)
    ratio = jnp.exp(policy(params, obs).log_prob(action) - old_log_prob)
    stats = TrpoStats(
        gain=masked_mean((ratio - 1.0) * advantage, mask), kl=kl(params), accepted=running, attempts=epochs * full
    )
    return params, opt_state, stats
