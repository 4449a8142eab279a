"""train_pol of Algorithm 1: TRPO iterations on episodes that begin in rho_i."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, make_baseline, make_policy
from rcg_jax.rl.masked import masked_mean
from rcg_jax.rl.ppo import ppo_step
from rcg_jax.rl.rollout import EnvState, Sampler, Transition, begin, label_starts, rollout, whole_episodes
from rcg_jax.rl.trpo import TrpoStats, trpo_step
from rcg_jax.sharding.devices import over_devices
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet

#: Samples of a Fisher product where held actions leave only a few, at most: a share of few would be too small.
MIN_FISHER = 1_000


@struct.dataclass
class Batch:
    """B samples in random order: what one improvement of an agent is made from.

    Attributes:
        obs: (B, obs_dim) raw observations.
        action: (B, nu) as sampled, before clipping.
        advantage: (B,), standardised.
        target: (B,) lambda-returns, what V is fitted to.
        count: () int32, of whole episodes: only the first so many samples belong to the batch; None: all.
    """

    obs: Array
    action: Array
    advantage: Array
    target: Array
    count: Array | None = None


@struct.dataclass
class TrpoIteration:
    """What one TRPO iteration showed.

    Attributes:
        labels: outcomes of the starts.
        trpo: what the policy step did.
        value_error: () root mean squared error of V before it was fitted.
        nonfinite: () int32, episodes ended by non-finite numbers.
        env_steps: () int32, physics steps simulated, those included that belong to no whole episode.
    """

    labels: StartLabels
    trpo: TrpoStats
    value_error: Array
    nonfinite: Array
    env_steps: Array


def make_train_policy(config: Config, task: Task) -> Callable[..., tuple[Agent, TrpoIteration]]:
    """The TRPO iterations of one curriculum iteration.

    Args:
        config: resolved settings (:func:`rcg_jax.rl.sizes.with_sizes`).
        task: task and physics.

    Returns:
        (key of the first starts, key of the training, agent, starts, whether to update the observation statistics,
        trust region [nats]) -> (agent, what each iteration showed; the labels are summed).
    """
    iteration = make_trpo_iteration(config, task)
    envs, inner = config.rollout.num_envs, config.trpo.iterations
    length = config.rollout.batch_size // envs

    def train_policy(
        begin_key: Array, key: Array, agent: Agent, starts: StartSet, *, learn_norm: Array, max_kl: Array
    ) -> tuple[Agent, TrpoIteration]:
        env = begin(task, begin_key, starts, envs)

        def inner_step(carry: tuple[Agent, EnvState], x: tuple[Array, Array]) -> tuple[tuple[Agent, EnvState], Any]:
            i, key = x
            agent, env, shown = iteration(
                key, *carry, starts, remaining=(inner - i) * length, learn_norm=learn_norm, max_kl=max_kl
            )
            return (agent, env), shown

        (agent, _), shown = jax.lax.scan(inner_step, (agent, env), (jnp.arange(inner), jax.random.split(key, inner)))
        return agent, shown.replace(labels=jax.tree.map(lambda x: jnp.sum(x, axis=0), shown.labels))

    return train_policy


def make_trpo_iteration(config: Config, task: Task) -> Callable[..., tuple[Agent, EnvState, TrpoIteration]]:
    """One TRPO iteration: a batch, advantages, policy step, baseline fit.

    Returns:
        (key, agent, env, starts, remaining physics steps, whether to update the observation statistics, trust region
        [nats]) -> (agent, env, what it showed). Where batches are whole episodes, ``env`` stays as it is.
    """
    repeat = config.policy.action_repeat
    policy = make_policy(config, task.action_dim, repeat)
    envs = config.rollout.num_envs
    length = config.rollout.batch_size // (envs * repeat)
    whole = config.rollout.batch == "episodes"

    def iteration(
        key: Array, agent: Agent, env: EnvState, starts: StartSet, *, remaining: Array, learn_norm: Array, max_kl: Array
    ) -> tuple[Agent, EnvState, TrpoIteration]:
        rollout_key, shuffle_key = jax.random.split(key)
        sampler = Sampler(
            task,
            lambda obs, noise: policy(agent.policy, agent.norm(obs)).sample(noise),
            repeat=repeat,
            gamma=config.trpo.gamma,
            distance_weight=config.distance_weight if config.reward == "distance" else 0.0,
        )
        if whole:
            steps = whole_episodes(sampler, rollout_key, starts, num_envs=envs, length=length)
            part, rows = steps.counted, jnp.sum(jnp.any(steps.counted, axis=1), dtype=jnp.int32)
        else:
            env, steps = rollout(sampler, rollout_key, env, starts, length=length, remaining=remaining)
            part, rows = jnp.ones_like(steps.counted), jnp.int32(length)
        batch, error = (episode_batch if whole else segment_batch)(config, shuffle_key, agent, steps)
        after, stats = update_agent(config, agent, batch, learn_norm=learn_norm, max_kl=max_kl, least=length * envs)
        shown = TrpoIteration(
            labels=label_starts(steps, starts.capacity),
            trpo=stats,
            value_error=error,
            nonfinite=jnp.sum(steps.bad & part),
            env_steps=rows * (envs * repeat),
        )
        return after, env, shown

    return iteration


def segment_batch(config: Config, key: Array, agent: Agent, steps: Transition) -> tuple[Batch, Array]:
    """The steps of a segment in random order, and the root mean squared error of V, ().

    One shuffle serves the Fisher sample and the minibatches. Whole rows change places: each holds all environments, and
    sorting L numbers is far cheaper than sorting the batch.
    """
    nothing_follows = steps.terminal if config.rollout.value_at_horizon else steps.done
    advantage, target, error = _advantages(config, agent, steps, nothing_follows)
    order = jax.random.permutation(key, steps.obs.shape[0])

    def shuffled(x: Array) -> Array:
        return over_devices(x[order].reshape(-1, *x.shape[2:]))

    batch = Batch(shuffled(steps.obs), shuffled(steps.action), shuffled(standardized(advantage)), shuffled(target))
    return batch, jnp.sqrt(jnp.mean(error))


def episode_batch(config: Config, key: Array, agent: Agent, steps: Transition) -> tuple[Batch, Array]:
    """The steps of whole episodes in random order, behind them zeros in place of the others; and the error of V, ().

    Nothing follows a whole episode, whatever ended it.
    """
    advantage, target, error = _advantages(config, agent, steps, steps.done)
    counted = steps.counted.reshape(-1)
    order = jnp.argsort(jnp.where(counted, jax.random.uniform(key, counted.shape), 2.0))
    count = jnp.sum(counted, dtype=jnp.int32)

    def shuffled(x: Array) -> Array:
        x = x.reshape(-1, *x.shape[2:])[order]
        return over_devices(jnp.where((jnp.arange(len(order)) < count).reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0))

    advantage = standardized(advantage, steps.counted)
    batch = Batch(shuffled(steps.obs), shuffled(steps.action), shuffled(advantage), shuffled(target), count)
    return batch, jnp.sqrt(masked_mean(error.reshape(-1), counted))


def _advantages(config: Config, agent: Agent, steps: Transition, nothing_follows: Array) -> tuple[Array, Array, Array]:
    """Advantages, lambda-returns and squared errors of V, each (L, N)."""
    baseline, repeat = make_baseline(config), config.policy.action_repeat
    value = baseline(agent.baseline, agent.norm(steps.obs))
    next_value = baseline(agent.baseline, agent.norm(steps.next_obs))
    advantage, target = generalized_advantage(
        steps.reward,
        value,
        next_value,
        nothing_follows,
        steps.done,
        gamma=config.trpo.gamma**repeat,
        lam=config.trpo.gae_lambda**repeat,
    )
    return advantage, target, (target - value) ** 2


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
    return min(batch, max(1, round(share), min(MIN_FISHER, round(share * repeat))))


def update_agent(
    config: Config,
    agent: Agent,
    batch: Batch,
    *,
    learn_norm: Array,
    max_kl: Array | float | None = None,
    least: int | None = None,
) -> tuple[Agent, TrpoStats]:
    """A TRPO or PPO step, a fit of V, and new observation statistics for what comes after.

    Args:
        config: settings of TRPO, or PPO, policy and baseline.
        agent: the agent that made the batch.
        batch: in random order: the Fisher sample and the minibatches are slices of it.
        learn_norm: () bool, whether the observation statistics are updated.
        max_kl: (), the trust region [nats]; by default that of ``config.trpo``.
        least: of batches with a ``count``: its least value (static).

    Returns:
        The agent, and what the policy step did.
    """
    repeat = config.policy.action_repeat
    least = batch.obs.shape[0] if least is None else least
    mask = None if batch.count is None else jnp.arange(batch.obs.shape[0]) < batch.count
    seen = agent.norm(batch.obs)
    policy, optimizer = make_policy(config, batch.action.shape[-1]), agent.optimizer
    if config.algorithm == "ppo":
        params, optimizer, stats = ppo_step(
            policy,
            agent.policy,
            optimizer,
            obs=seen,
            action=batch.action,
            advantage=batch.advantage,
            config=config.ppo,
            saturation_penalty=config.trpo.saturation_penalty,
            minibatch=min(least, max(1, config.ppo.minibatch_size // repeat)),
            count=batch.count,
        )
    else:
        num_fisher = fisher_samples(config, least, repeat)
        params, stats = trpo_step(
            policy,
            agent.policy,
            seen,
            batch.action,
            batch.advantage,
            fisher_obs=over_devices(seen[:num_fisher]),
            scale_obs=over_devices(seen[least - num_fisher : least]),
            config=config.trpo,
            max_kl=max_kl,
            mask=mask,
        )
    fitted = make_baseline(config, repeat).fit(agent.baseline, seen, batch.target, batch.count, least)
    norm = jax.tree.map(lambda a, b: jnp.where(learn_norm, a, b), agent.norm.update(batch.obs, mask), agent.norm)
    return Agent(policy=params, baseline=fitted, norm=norm, optimizer=optimizer), stats
