"""One improvement of an agent from a batch of transitions: policy step, baseline fit, observation statistics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.rl.agent import Agent, make_baseline, make_policy
from rcg_jax.rl.masked import masked_mean
from rcg_jax.rl.trpo import TrpoStats, trpo_step
from rcg_jax.sharding.devices import over_devices

#: With held actions a share of the batch may be few samples; up to so many are taken all the same.
LEAST_FISHER = 1_000


def standardized(advantage: Array, mask: Array | None = None) -> Array:
    """Advantages (B, ...) with mean 0 and standard deviation 1, of those that ``mask`` has; None: of all."""
    if mask is None:
        return (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    centred = advantage - masked_mean(advantage.reshape(-1), mask.reshape(-1))
    return centred / (jnp.sqrt(masked_mean((centred**2).reshape(-1), mask.reshape(-1))) + 1e-8)


def fisher_samples(config: Config, batch: int, repeat: int = 1) -> int:
    """How many of ``batch`` samples, actions held for ``repeat`` steps, are in Fisher products.

    The share of them; where held actions leave too few, as many as of the same steps without, up to 1,000.
    """
    share = config.trpo.fisher_fraction * batch
    return min(batch, max(1, round(share), min(LEAST_FISHER, round(share * repeat))))


def improve(
    config: Config,
    agent: Agent,
    obs: Array,
    action: Array,
    advantage: Array,
    target: Array,
    learn_norm: Array,
    max_kl: Array | float | None = None,
    repeat: int = 1,
    *,
    least: int | None = None,
    count: Array | None = None,
) -> tuple[Agent, TrpoStats]:
    """A TRPO step, a fit of V, and new observation statistics for what comes after.

    Args:
        config: settings of TRPO, policy and baseline.
        agent: the agent that made the transitions.
        obs: (B, obs_dim) raw observations in random order: the Fisher sample and the minibatches are slices.
        action: (B, nu) actions as sampled, before clipping.
        advantage: (B,), standardised.
        target: (B,) lambda-returns, what V is fitted to.
        learn_norm: () bool, whether the observation statistics are updated.
        max_kl: (), the trust region [nats]; by default that of ``config.trpo``.
        repeat: k, physics steps of each action.
        least, count: of batches of whole episodes: only the first ``count`` () samples belong to the batch, and these
            are at least ``least`` (static).

    Returns:
        The agent, and what the policy step did.
    """
    least = obs.shape[0] if least is None else least
    num_fisher = fisher_samples(config, least, repeat)
    mask = None if count is None else jnp.arange(obs.shape[0]) < count
    seen = agent.norm(obs)
    params, stats = trpo_step(
        make_policy(config, action.shape[-1]),
        agent.policy,
        seen,
        action,
        advantage,
        fisher_obs=over_devices(seen[:num_fisher]),
        scale_obs=over_devices(seen[least - num_fisher : least]),
        config=config.trpo,
        max_kl=max_kl,
        mask=mask,
    )
    fitted = make_baseline(config, repeat).fit(agent.baseline, seen, target, count)
    norm = jax.tree.map(lambda a, b: jnp.where(learn_norm, a, b), agent.norm.update(obs, mask), agent.norm)
    return Agent(policy=params, baseline=fitted, norm=norm), stats
