"""One improvement of an agent from a batch of transitions: policy step, baseline fit, observation statistics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config import Config
from rcg_jax.devices import over_devices
from rcg_jax.rl.agent import Agent, make_baseline, make_policy
from rcg_jax.rl.trpo import TrpoStats, trpo_step

#: With held actions a share of the batch may be few samples; up to so many are taken all the same.
LEAST_FISHER = 1_000


def standardized(advantage: Array) -> Array:
    """Advantages with mean 0 and standard deviation 1."""
    return (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)


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

    Returns:
        The agent, and what the policy step did.
    """
    num_fisher = fisher_samples(config, obs.shape[0], repeat)
    seen = agent.norm(obs)
    params, stats = trpo_step(
        make_policy(config, action.shape[-1]),
        agent.policy,
        seen,
        action,
        advantage,
        fisher_obs=over_devices(seen[:num_fisher]),
        scale_obs=over_devices(seen[-num_fisher:]),
        config=config.trpo,
        max_kl=max_kl,
    )
    fitted = make_baseline(config, repeat).fit(agent.baseline, seen, target)
    norm = jax.tree.map(lambda a, b: jnp.where(learn_norm, a, b), agent.norm.update(obs), agent.norm)
    return Agent(policy=params, baseline=fitted, norm=norm), stats
