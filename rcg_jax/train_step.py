"""Algorithm 1, the loop body: one compiled train step, a pure function of one pytree.

For i = 1 to Iter, from starts = [s^g] and starts_old = [s^g]:

1. new starts by SampleNearby, N_old of the replay: ``method.propose``
2. train_pol on rho_i = Unif(starts): ``train_policy``
3. R(pi, s_0) of every start: the labels that training leaves behind
4. select, and append the good starts to the replay: ``method.update``
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.methods import make_method
from rcg_jax.rl.agent import Agent, init_agent
from rcg_jax.rl.metrics import Metrics, make_metrics
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.rl.train_policy import make_train_policy
from rcg_jax.rl.trpo import trust_region_radius
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet


@struct.dataclass
class TrainState:
    """The whole state of a run; nothing else is needed to continue it.

    Attributes:
        key: PRNG key.
        iteration: () int32, curriculum iterations done.
        agent: policy and baseline.
        method: the start-state method's own state: starts, replay.
        starts: rho_i of the last iteration.
        labels: R(pi, s_0) of them, which the next iteration's trust region depends on.
    """

    key: Array
    iteration: Array
    agent: Agent
    method: Any
    starts: StartSet
    labels: StartLabels


def init_train_state(config: Config, task: Task, seed: int) -> TrainState:
    """The state before the first iteration. Seeds differ in everything random, and in nothing else."""
    key, agent_key, method_key = jax.random.split(jax.random.key(seed), 3)
    agent = init_agent(config, agent_key, task.obs_dim, task.action_dim)
    method = make_method(config.method, task, with_sizes(config, task.horizon))
    method_state = method.init(method_key)
    _, starts = jax.eval_shape(method.propose, method_key, method_state, agent)
    starts = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), starts)
    return TrainState(
        key=key,
        iteration=jnp.int32(0),
        agent=agent,
        method=method_state,
        starts=starts,
        labels=StartLabels.none(starts.capacity),
    )


def make_train_step(config: Config, task: Task) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Algorithm 1's loop body. Pure, not yet jitted.

    Raises:
        ConfigError: sizes that do not fit the task (:func:`rcg_jax.rl.sizes.with_sizes`), or a method that does not.
    """
    config = with_sizes(config, task.horizon)
    method = make_method(config.method, task, config)
    train_policy = make_train_policy(config, task)

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        key, propose_key, begin_key, train_key, update_key = jax.random.split(state.key, 5)
        # 1. SampleNearby (section 4.2) and the replay (4.3)
        proposing, starts = method.propose(propose_key, state.method, state.agent)
        # 2. train_pol. Ours, off with preset=paper: observation statistics of the first iterations; a smaller trust
        # region once few episodes fail.
        learn_norm = state.iteration < config.policy.obs_norm_iterations
        max_kl = trust_region_radius(config.trpo, state.labels)
        agent, shown = train_policy(begin_key, train_key, state.agent, starts, learn_norm=learn_norm, max_kl=max_kl)
        # 3. R(pi, s_0): shown.labels. 4. select (section 4.1), and append to the replay
        method_state, method_metrics = method.update(update_key, proposing, starts, shown.labels)
        after = TrainState(
            key=key,
            iteration=state.iteration + 1,
            agent=agent,
            method=method_state,
            starts=starts,
            labels=shown.labels,
        )
        return after, make_metrics(task, after, shown, method_metrics)

    return train_step
