"""The parts of a train step as functions of their own, to be compiled and timed one by one.

They see what the train step sees: the same starts, the same transitions, the same agent. A TRPO iteration's parts are
those of the first one of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from rcg_jax.config.settings import Config
from rcg_jax.methods import make_method
from rcg_jax.physics.jit import jit
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, make_baseline, make_policy
from rcg_jax.rl.conjugate_gradient import conjugate_gradient
from rcg_jax.rl.improve import fisher_samples, standardized
from rcg_jax.rl.line_search import backtracking_line_search
from rcg_jax.rl.rollout import EnvState, Sampler, Transition, begin, label_starts, rollout
from rcg_jax.rl.sizes import action_repeat, batch_size, num_envs
from rcg_jax.rl.trpo import fisher_product
from rcg_jax.tasks import Task
from rcg_jax.train_step import TrainState
from rcg_jax.types import PhysicsState, StartLabels, StartSet

WALKS, PHYSICS, ROLLOUT = "Brownian walks and choice of starts", "physics of the rollouts", "rollouts"
ADVANTAGES, GRADIENT = "advantages and shuffling", "policy gradient"
FISHER, LINE_SEARCH, BASELINE = "Fisher products and CG", "line search", "baseline fit"
LABELS = "labels, curriculum update, statistics"


@dataclass(frozen=True)
class Part:
    """A part of the train step.

    Attributes:
        name: what it is.
        times: how often a step does it.
        run: does it once and waits.
    """

    name: str
    times: int
    run: Callable[[], Any]


def make_rollout(config: Config, task: Task) -> Callable[..., tuple[EnvState, Transition]]:
    """(key, agent, environments, starts) -> environments and transitions of the first TRPO iteration of a step."""
    repeat = action_repeat(config, task)
    policy = make_policy(config, task.action_dim, repeat)
    steps = batch_size(config, task) // num_envs(config, task)

    def roll(key: Array, agent: Agent, env: EnvState, starts: StartSet) -> tuple[EnvState, Transition]:
        def act(obs: Array, noise: Array) -> Array:
            return policy(agent.policy, agent.norm(obs)).sample(noise)

        remaining = jnp.int32(steps * config.trpo.iterations)
        length = steps // repeat
        sampler = Sampler(task, act, repeat=repeat, gamma=config.trpo.gamma)
        return rollout(sampler, key, env, starts, length=length, remaining=remaining)

    return roll


def make_advantages(
    config: Config, repeat: int
) -> Callable[[Array, Agent, Transition], tuple[Array, Array, Array, Array]]:
    """(key, agent, transitions) -> what :func:`rcg_jax.rl.improve.improve` takes, in random order."""
    baseline, trpo = make_baseline(config), config.trpo
    gamma, lam = trpo.gamma**repeat, trpo.gae_lambda**repeat

    def advantages(key: Array, agent: Agent, batch: Transition) -> tuple[Array, Array, Array, Array]:
        value = baseline(agent.baseline, agent.norm(batch.obs))
        next_value = baseline(agent.baseline, agent.norm(batch.next_obs))
        advantage, target = generalized_advantage(
            batch.reward, value, next_value, batch.terminal, batch.done, gamma=gamma, lam=lam
        )
        order = jax.random.permutation(key, batch.reward.shape[0])
        arrays = (batch.obs, batch.action, standardized(advantage), target)
        obs, action, good, target = (x[order].reshape(-1, *x.shape[2:]) for x in arrays)
        return obs, action, good, target

    return advantages


def make_parts(config: Config, task: Task, state: TrainState) -> list[Part]:
    """Compiles the parts of the step that ``state`` would take next.

    :data:`ROLLOUT` contains :data:`PHYSICS`: policy and bookkeeping are the difference.
    """
    method = make_method(config.method, task, config)
    repeat = action_repeat(config, task)
    policy, baseline = make_policy(config, task.action_dim), make_baseline(config, repeat)
    trpo, inner, envs = config.trpo, config.trpo.iterations, num_envs(config, task)
    agent = state.agent
    parts: list[Part] = []

    def part(name: str, times: int, fun: Callable[..., Any], *args: Any) -> Any:
        compiled = jit(fun, fusion_emitters=task.engine.fusion_emitters).lower(*args).compile()
        parts.append(Part(name, times, lambda: jax.block_until_ready(compiled(*args))))
        return parts[-1].run()

    _, propose_key, begin_key, train_key, update_key = jax.random.split(state.key, 5)
    key = jax.random.split(train_key, inner)[0]
    rollout_key, shuffle_key = jax.random.split(key)

    proposing, starts = part(WALKS, 1, method.propose, propose_key, state.method, agent)
    env: EnvState = jit(lambda key, starts: begin(task, key, starts, envs))(begin_key, starts)

    after, batch = part(ROLLOUT, inner, make_rollout(config, task), rollout_key, agent, env, starts)

    def step_physics(env: EnvState, starts: StartSet, action: Array, done: Array, fresh: Array) -> PhysicsState:
        def step(physics: PhysicsState, x: tuple[Array, Array, Array]) -> tuple[PhysicsState, None]:
            action, done, fresh = x

            def pick(new: Array, old: Array) -> Array:
                return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

            for _ in range(repeat):
                physics = task.step(physics, action)
            return jax.tree.map(pick, task.reset(starts.take(fresh)), physics), None

        return jax.lax.scan(step, env.physics, (action, done, fresh))[0]

    fresh = jnp.concatenate([batch.start[1:], after.start[None]])
    part(PHYSICS, inner, step_physics, env, starts, batch.action, batch.done, fresh)

    obs, action, advantage, target = part(ADVANTAGES, inner, make_advantages(config, repeat), shuffle_key, agent, batch)
    obs = agent.norm(obs)
    flat, unravel = ravel_pytree(agent.policy)

    def gradient(flat: Array, obs: Array, action: Array, advantage: Array) -> tuple[Array, Any]:
        def score(theta: Array) -> tuple[Array, Any]:
            dist = policy(unravel(theta), obs)
            return jnp.mean(dist.log_prob(action) * advantage), dist

        slope, old = jax.grad(score, has_aux=True)(flat)
        return slope, (old, old.log_prob(action))

    slope, (old, old_log_prob) = part(GRADIENT, inner, gradient, flat, obs, action, advantage)
    num_fisher = fisher_samples(config, obs.shape[0], repeat)

    def direction(flat: Array, obs: Array, slope: Array) -> Array:
        product = fisher_product(policy, unravel(flat), obs[:num_fisher], trpo.cg_damping)
        found = conjugate_gradient(product, slope, iterations=trpo.cg_iterations)
        curved = fisher_product(policy, unravel(flat), obs[-num_fisher:], trpo.cg_damping)(found)
        scale = trpo.step_scale * jnp.sqrt(2.0 * trpo.max_kl / jnp.maximum(found @ curved, 1e-20))
        return scale * found

    full_step = part(FISHER, inner, direction, flat, obs, slope)

    def search(flat: Array, full_step: Array, obs: Array, action: Array, advantage: Array, old: Any, log: Array) -> Any:
        def gain_and_kl(theta: Array) -> tuple[Array, Array]:
            dist = policy(unravel(theta), obs)
            ratio = jnp.exp(dist.log_prob(action) - log)
            return jnp.mean((ratio - 1.0) * advantage), jnp.mean(old.kl(dist))

        return backtracking_line_search(
            gain_and_kl,
            flat,
            full_step,
            max_kl=trpo.max_kl,
            ratio=trpo.backtrack_ratio,
            max_backtracks=trpo.max_backtracks,
        )

    part(LINE_SEARCH, inner, search, flat, full_step, obs, action, advantage, old, old_log_prob)
    part(BASELINE, inner, baseline.fit, agent.baseline, obs, target)

    def update(key: Array, proposing: Any, starts: StartSet, batch: Transition, agent: Agent) -> Any:
        # Labels and statistics of all TRPO iterations, of which this part holds one: the others are alike.
        def one(total: StartLabels, _: Array) -> tuple[StartLabels, Any]:
            labels = label_starts(jax.lax.optimization_barrier(batch), starts.capacity)
            return jax.tree.map(jnp.add, total, labels), agent.norm.update(jax.lax.optimization_barrier(batch.obs))

        labels, norm = jax.lax.scan(one, StartLabels.none(starts.capacity), jnp.arange(inner))
        distance = jax.vmap(task.distance)(task.snapshot(task.reset(starts)))
        return method.update(key, proposing, starts, labels), norm, distance

    part(LABELS, 1, update, update_key, proposing, starts, batch, agent)
    return parts
