"""One compiled train step: the body of Algorithm 1 as a pure function of one pytree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.methods import make_method
from rcg_jax.methods.base import MethodMetrics
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, init_agent, make_baseline, make_policy
from rcg_jax.rl.hold import decisions
from rcg_jax.rl.improve import improve, standardized
from rcg_jax.rl.masked import masked_mean
from rcg_jax.rl.rollout import EnvState, Sampler, Transition, begin, label_starts, rollout, whole_episodes
from rcg_jax.rl.sizes import action_repeat, batch_size, num_envs
from rcg_jax.rl.trpo import TrpoStats, trust_region
from rcg_jax.sharding.devices import over_devices
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet


@struct.dataclass
class TrainState:
    """The whole state of a run; nothing else is needed to continue it.

    Attributes:
        key: PRNG key.
        iteration: () int32, curriculum iterations done.
        agent: policy and baseline.
        method: the start-state method's own state.
        starts: rho_i of the last iteration, for reports.
        labels: what training showed about them.
    """

    key: Array
    iteration: Array
    agent: Agent
    method: Any
    starts: StartSet
    labels: StartLabels


@struct.dataclass
class Metrics:
    """One iteration in numbers; all scalars.

    Attributes:
        iteration: curriculum iterations done, this one included.
        env_steps: physics steps of policy rollouts in this iteration, all that were simulated; logs hold their sum,
            which int32 could not.
        success: share of the counted episodes on rho_i that reached the goal.
        episodes: episodes counted.
        start_distance: mean distance of rho_i's starts to the goal [m].
        nonfinite: episodes ended by physics, an observation or a penalised distance that turned non-finite.
        kl, surrogate_gain, line_search_attempts: means over the TRPO iterations. accepted: share of accepted steps.
        policy_std: mean standard deviation of the policy.
        value_error: root mean squared error of V before it was fitted, mean over the TRPO iterations.
        starts: what the start-state method reports.
    """

    iteration: Array
    env_steps: Array
    success: Array
    episodes: Array
    start_distance: Array
    nonfinite: Array
    kl: Array
    surrogate_gain: Array
    line_search_attempts: Array
    accepted: Array
    policy_std: Array
    value_error: Array
    starts: MethodMetrics


def init_train_state(config: Config, task: Task, seed: int) -> TrainState:
    """The state before the first iteration. Seeds differ in everything random, and in nothing else."""
    key, agent_key, method_key = jax.random.split(jax.random.key(seed), 3)
    agent = init_agent(config, agent_key, task.obs_dim, task.action_dim, task.init_std)
    method = make_method(config.method, task, config)
    method_state = method.init(method_key)
    _, starts = jax.eval_shape(method.propose, key, method_state, agent)
    starts = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), starts)
    return TrainState(
        key=key,
        iteration=jnp.int32(0),
        agent=agent,
        method=method_state,
        starts=starts,
        labels=StartLabels.none(starts.capacity),
    )


@struct.dataclass
class Batch:
    """B samples in random order, what a TRPO iteration trains on.

    Attributes:
        obs: (B, obs_dim) raw observations.
        action: (B, nu) as sampled.
        advantage: (B,), standardised.
        target: (B,) lambda-returns.
        count: () int32, how many of them, from the first one on, are steps of whole episodes; None: all.
    """

    obs: Array
    action: Array
    advantage: Array
    target: Array
    count: Array | None


def _shuffled_rows(key: Array, batch: Transition, advantage: Array, target: Array) -> Batch:
    """The steps of a segment. One shuffle serves the Fisher sample and the minibatches.

    Whole rows change places: each holds all environments, and sorting L numbers is far cheaper than sorting the batch.
    """
    order = jax.random.permutation(key, batch.obs.shape[0])

    def shuffled(x: Array) -> Array:
        return over_devices(x[order].reshape(-1, *x.shape[2:]))

    advantage = standardized(advantage)
    return Batch(shuffled(batch.obs), shuffled(batch.action), shuffled(advantage), shuffled(target), None)


def _shuffled_episodes(key: Array, batch: Transition, advantage: Array, target: Array) -> Batch:
    """The steps of whole episodes, and behind them zeros in place of the others."""
    counted = batch.counted.reshape(-1)
    order = jnp.argsort(jnp.where(counted, jax.random.uniform(key, counted.shape), 2.0))
    count = jnp.sum(counted, dtype=jnp.int32)

    def shuffled(x: Array) -> Array:
        x = x.reshape(-1, *x.shape[2:])[order]
        return over_devices(jnp.where((jnp.arange(len(order)) < count).reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0))

    advantage = standardized(advantage, batch.counted)
    return Batch(shuffled(batch.obs), shuffled(batch.action), shuffled(advantage), shuffled(target), count)


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


def make_trpo_iteration(
    config: Config, task: Task
) -> Callable[[Array, Agent, EnvState, StartSet, Array, Array, Array], tuple[Agent, EnvState, TrpoIteration]]:
    """One TRPO iteration: a batch, advantages, policy step, baseline fit.

    Returns:
        (key, agent, env, starts, remaining physics steps, whether to update the observation statistics, trust region
        [nats]) -> (agent, env, what it showed). Where batches are whole episodes, ``env`` stays as it is.
    """
    repeat = action_repeat(config, task)
    policy, baseline = make_policy(config, task.action_dim, repeat), make_baseline(config)
    trpo, envs = config.trpo, num_envs(config, task)
    length = batch_size(config, task) // (envs * repeat)
    gamma, lam = trpo.gamma**repeat, trpo.gae_lambda**repeat
    whole = config.rollout.batch == "episodes"

    def iteration(
        key: Array, agent: Agent, env: EnvState, starts: StartSet, remaining: Array, learn_norm: Array, max_kl: Array
    ) -> tuple[Agent, EnvState, TrpoIteration]:
        rollout_key, shuffle_key = jax.random.split(key)
        sampler = Sampler(
            task,
            lambda obs, noise: policy(agent.policy, agent.norm(obs)).sample(noise),
            repeat=repeat,
            gamma=trpo.gamma,
            distance_weight=config.distance_weight if config.reward == "distance" else 0.0,
        )
        if whole:
            batch = whole_episodes(sampler, rollout_key, starts, num_envs=envs, length=length)
            part, rows = batch.counted, jnp.sum(jnp.any(batch.counted, axis=1), dtype=jnp.int32)
        else:
            env, batch = rollout(sampler, rollout_key, env, starts, length=length, remaining=remaining)
            part, rows = jnp.ones_like(batch.counted), jnp.int32(length)
        obs = agent.norm(batch.obs)
        value = baseline(agent.baseline, obs)
        next_value = baseline(agent.baseline, agent.norm(batch.next_obs))
        # Nothing follows a whole episode, whatever ended it.
        nothing_follows = batch.done if whole or not config.rollout.value_at_horizon else batch.terminal
        advantage, target = generalized_advantage(
            batch.reward, value, next_value, nothing_follows, batch.done, gamma=gamma, lam=lam
        )
        error = (target - value) ** 2
        shuffled = (_shuffled_episodes if whole else _shuffled_rows)(shuffle_key, batch, advantage, target)
        after, stats = improve(
            config,
            agent,
            shuffled.obs,
            shuffled.action,
            shuffled.advantage,
            shuffled.target,
            learn_norm,
            max_kl,
            repeat,
            least=length * envs,
            count=shuffled.count,
        )
        shown = TrpoIteration(
            labels=label_starts(batch, starts.capacity),
            trpo=stats,
            value_error=jnp.sqrt(masked_mean(error.reshape(-1), part.reshape(-1)) if whole else jnp.mean(error)),
            nonfinite=jnp.sum(batch.bad & part),
            env_steps=rows * (envs * repeat),
        )
        return after, env, shown

    return iteration


def make_train_step(config: Config, task: Task) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Algorithm 1's loop body: propose rho_i, train_pol (TRPO iterations), select, append. Pure, not yet jitted.

    Raises:
        ConfigError: the environments do not divide a TRPO iteration's steps, or the TRPO iterations of one curriculum
            iteration, of segments, are too short for one whole episode.
    """
    method = make_method(config.method, task, config)
    iteration = make_trpo_iteration(config, task)
    envs, inner = num_envs(config, task), config.trpo.iterations
    batch, repeat = batch_size(config, task), action_repeat(config, task)
    if repeat > task.horizon:
        raise ConfigError(f"policy.action_repeat={repeat}: must be <= {task.horizon}, the steps of an episode")
    if config.rollout.batch_size % repeat:
        raise ConfigError(f"rollout.batch_size={batch}: must be a multiple of policy.action_repeat={repeat}")
    if batch % (envs * repeat):
        raise ConfigError(
            f"rollout.num_envs={envs}: times policy.action_repeat={repeat} must divide the steps of a TRPO iteration, "
            f"{batch} for horizon {task.horizon}"
        )
    length = batch // envs
    total = length * inner
    longest = decisions(task.horizon, repeat) * repeat
    if total < longest and config.rollout.batch == "segments":
        raise ConfigError(
            f"rollout.num_envs={envs}: must be <= {batch * inner // longest}, so that "
            f"trpo.iterations * rollout.batch_size / rollout.num_envs = {total} steps hold one episode of "
            f"{longest} steps"
        )

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        key, propose_key, begin_key, train_key, update_key = jax.random.split(state.key, 5)
        proposing, starts = method.propose(propose_key, state.method, state.agent)
        env = begin(task, begin_key, starts, envs)
        learn_norm = state.iteration < config.policy.obs_norm_iterations
        max_kl = trust_region(config.trpo, state.labels)

        def inner_step(carry: tuple[Agent, EnvState], x: tuple[Array, Array]) -> tuple[tuple[Agent, EnvState], Any]:
            i, key = x
            agent, env, out = iteration(key, *carry, starts, total - i * length, learn_norm, max_kl)
            return (agent, env), out

        (agent, _), shown = jax.lax.scan(
            inner_step, (state.agent, env), (jnp.arange(inner), jax.random.split(train_key, inner))
        )
        labels = jax.tree.map(lambda x: jnp.sum(x, axis=0), shown.labels)
        trpo = shown.trpo
        method_state, method_metrics = method.update(update_key, proposing, starts, labels)
        distance = jax.vmap(task.distance)(task.snapshot(task.reset(starts)))
        known = starts.valid & jnp.isfinite(distance)
        after = TrainState(
            key=key,
            iteration=state.iteration + 1,
            agent=agent,
            method=method_state,
            starts=starts,
            labels=labels,
        )
        episodes = jnp.sum(labels.episodes)
        metrics = Metrics(
            iteration=after.iteration,
            env_steps=jnp.sum(shown.env_steps),
            success=jnp.sum(labels.successes) / jnp.maximum(episodes, 1),
            episodes=episodes,
            start_distance=jnp.sum(jnp.where(known, distance, 0.0)) / jnp.maximum(jnp.sum(known), 1),
            nonfinite=jnp.sum(shown.nonfinite),
            kl=jnp.mean(trpo.kl),
            surrogate_gain=jnp.mean(trpo.gain),
            line_search_attempts=jnp.mean(trpo.attempts),
            accepted=jnp.mean(trpo.accepted),
            policy_std=jnp.mean(jnp.exp(agent.policy.log_std)),
            value_error=jnp.mean(shown.value_error),
            starts=method_metrics,
        )
        return after, metrics

    return train_step


__all__ = ["Metrics", "TrainState", "init_train_state", "make_train_step"]
