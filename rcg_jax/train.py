"""One compiled train step: the body of Algorithm 1 as a pure function of one pytree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.base import StartLabels, StartSet
from rcg_jax.config import Config, ConfigError
from rcg_jax.devices import over_devices
from rcg_jax.methods import make_method
from rcg_jax.methods.method import MethodMetrics
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, init_agent, make_baseline, make_policy
from rcg_jax.rl.hold import decisions
from rcg_jax.rl.improve import improve, standardized
from rcg_jax.rl.rollout import EnvState, begin, label_starts, rollout
from rcg_jax.rl.sizes import action_repeat, batch_size, num_envs
from rcg_jax.rl.trpo import TrpoStats, trust_region
from rcg_jax.tasks.task import Task


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
        env_steps: steps of policy rollouts in this iteration; logs hold their sum, which int32 could not.
        success: share of the counted episodes on rho_i that reached the goal.
        episodes: episodes counted.
        start_distance: mean distance of rho_i's starts to the goal [m].
        nonfinite: episodes ended by non-finite physics.
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


def make_trpo_iteration(
    config: Config, task: Task
) -> Callable[[Array, Agent, EnvState, StartSet, Array, Array, Array], tuple[Agent, EnvState, tuple[Any, ...]]]:
    """One TRPO iteration: a rollout segment, advantages, policy step, baseline fit.

    Returns:
        (key, agent, env, starts, remaining physics steps, whether to update the observation statistics, trust region
        [nats]) -> (agent, env, (labels, TrpoStats, value error, non-finite episodes)).
    """
    repeat = action_repeat(config, task)
    policy, baseline = make_policy(config, task.action_dim, repeat), make_baseline(config)
    trpo = config.trpo
    length = batch_size(config, task) // (num_envs(config, task) * repeat)
    gamma, lam = trpo.gamma**repeat, trpo.gae_lambda**repeat
    weight = config.distance_weight if config.reward == "distance" else 0.0

    def iteration(
        key: Array, agent: Agent, env: EnvState, starts: StartSet, remaining: Array, learn_norm: Array, max_kl: Array
    ) -> tuple[Agent, EnvState, tuple[StartLabels, TrpoStats, Array, Array]]:
        rollout_key, shuffle_key = jax.random.split(key)
        env, batch = rollout(
            task,
            lambda obs, noise: policy(agent.policy, agent.norm(obs)).sample(noise),
            rollout_key,
            env,
            starts,
            length=length,
            remaining=remaining,
            repeat=repeat,
            gamma=trpo.gamma,
            distance_weight=weight,
        )
        obs = agent.norm(batch.obs)
        value = baseline(agent.baseline, obs)
        next_value = baseline(agent.baseline, agent.norm(batch.next_obs))
        advantage, target = generalized_advantage(
            batch.reward, value, next_value, batch.terminal, batch.done, gamma=gamma, lam=lam
        )
        value_error = jnp.sqrt(jnp.mean((target - value) ** 2))

        # One shuffle serves the Fisher sample and the minibatches. Whole rows change places: each holds all
        # environments, and sorting L numbers is far cheaper than sorting the batch.
        order = jax.random.permutation(shuffle_key, length)

        def shuffled(x: Array) -> Array:
            return over_devices(x[order].reshape(-1, *x.shape[2:]))

        after, stats = improve(
            config,
            agent,
            shuffled(batch.obs),
            shuffled(batch.action),
            shuffled(standardized(advantage)),
            shuffled(target),
            learn_norm,
            max_kl,
            repeat,
        )
        return after, env, (label_starts(batch, starts.capacity), stats, value_error, jnp.sum(batch.bad))

    return iteration


def make_train_step(config: Config, task: Task) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Algorithm 1's loop body: propose rho_i, train_pol (TRPO iterations), select, append. Pure, not yet jitted.

    Raises:
        ConfigError: the environments do not divide a TRPO iteration's steps, or the TRPO iterations of one curriculum
            iteration are too short for one whole episode.
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
    if total < longest:
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

        (agent, _), (labels, trpo, value_error, nonfinite) = jax.lax.scan(
            inner_step, (state.agent, env), (jnp.arange(inner), jax.random.split(train_key, inner))
        )
        labels = jax.tree.map(lambda x: jnp.sum(x, axis=0), labels)
        method_state, method_metrics = method.update(update_key, proposing, starts, labels)
        distance = jax.vmap(task.distance)(task.snapshot(task.reset(starts)))
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
            env_steps=jnp.int32(total * envs),
            success=jnp.sum(labels.successes) / jnp.maximum(episodes, 1),
            episodes=episodes,
            start_distance=jnp.sum(distance * starts.valid) / jnp.maximum(starts.count(), 1),
            nonfinite=jnp.sum(nonfinite),
            kl=jnp.mean(trpo.kl),
            surrogate_gain=jnp.mean(trpo.gain),
            line_search_attempts=jnp.mean(trpo.attempts),
            accepted=jnp.mean(trpo.accepted),
            policy_std=jnp.mean(jnp.exp(agent.policy.log_std)),
            value_error=jnp.mean(value_error),
            starts=method_metrics,
        )
        return after, metrics

    return train_step


__all__ = ["Metrics", "TrainState", "init_train_state", "make_train_step"]
