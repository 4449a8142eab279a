"""One improvement of an agent from a batch of transitions: policy step, baseline fit, observation statistics."""

from __future__ import annotations

from jax import Array

from rcg_jax.config import Config
from rcg_jax.rl.agent import Agent, make_baseline, make_policy
from rcg_jax.rl.trpo import TrpoStats, trpo_step


def improve(
    config: Config, agent: Agent, obs: Array, action: Array, advantage: Array, target: Array
) -> tuple[Agent, TrpoStats]:
    """A TRPO step and a fit of V.

    Args:
        config: settings of TRPO, policy and baseline.
        agent: the agent that made the transitions.
        obs: (B, obs_dim) normalised observations in random order: the Fisher sample and the minibatches are slices.
        action: (B, nu) actions as sampled, before clipping.
        advantage: (B,), standardised.
        target: (B,) lambda-returns, what V is fitted to.

    Returns:
        The agent with the same observation statistics, and what the policy step did.
    """
    num_fisher = max(1, round(config.trpo.fisher_fraction * obs.shape[0]))
    params, stats = trpo_step(
        make_policy(config, action.shape[-1]),
        agent.policy,
        obs,
        action,
        advantage,
        fisher_obs=obs[:num_fisher],
        scale_obs=obs[-num_fisher:],
        config=config.trpo,
    )
    fitted = make_baseline(config).fit(agent.baseline, obs, target)
    return agent.replace(policy=params, baseline=fitted), stats  # type: ignore[attr-defined]
