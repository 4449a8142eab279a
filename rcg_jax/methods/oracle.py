"""The upper bound: good starts found by rejection among uniform ones (section 5.2, "Oracle")."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.curriculum.replay import append, init_replay
from rcg_jax.methods.base import MethodMetrics, classify_starts
from rcg_jax.rl.agent import Agent, make_policy
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.tasks import TASKS, Task
from rcg_jax.types import StartLabels, StartSet, concatenate, sample_starts


@struct.dataclass
class OracleState:
    """What the oracle carries on.

    Attributes:
        replay: starts_old.
        labelling_steps: () float32, physics steps of the episodes that labelled the last proposal.
    """

    replay: StartSet
    labelling_steps: Array


class Oracle:
    """Uniform starts of S^0 whose empirical success under the current policy is between R_min and R_max.

    Orders of magnitude more expensive than the curriculum, as the paper says; ``proposal_steps`` counts its cost.
    """

    def __init__(self, task: Task, config: Config) -> None:
        """Rejection sampling on ``task``.

        Raises:
            ConfigError: the task cannot draw from S^0 itself.
        """
        if not task.has_exact_sampler():
            able = ", ".join(name for name, cls in TASKS.items() if cls.has_exact_sampler())
            raise ConfigError(
                f"method=oracle: task={task.name} cannot sample its feasible starts exactly; tasks that can: {able}, "
                "and classes of your own with sample_feasible"
            )
        self._task = task
        self._config = config
        self._policy = make_policy(config, task.action_dim, config.policy.action_repeat)

    def init(self, key: Array) -> OracleState:
        """The replay holds [s^g]."""
        replay = init_replay(self._task.goal_starts(), self._config.curriculum.replay_capacity)
        return OracleState(replay=replay, labelling_steps=jnp.zeros(()))

    def propose(self, key: Array, state: OracleState, agent: Agent) -> tuple[OracleState, StartSet]:
        """Up to N_new good starts, as many as the rounds found, then N_old of the replay.

        If there is none, the uniform starts of the last round that were not mastered take their place, and if all
        were, any of them.
        """
        cur, cfg = self._config.curriculum, self._config.oracle
        search_key, rest_key, old_key = jax.random.split(key, 3)
        Carry = tuple[Array, StartSet, StartSet, Array]

        def unfinished(carry: Carry) -> Array:
            return (carry[0] < cfg.max_rounds) & (carry[1].count() < cur.num_new)

        def search(carry: Carry) -> Carry:
            i, found, _, steps = carry
            point_key, episode_key = jax.random.split(jax.random.fold_in(search_key, i))
            points = self._task.sample_feasible(point_key, cfg.num_points)
            repeated = jax.tree.map(lambda x: jnp.repeat(x, cfg.rollouts, axis=0), points)
            episodes = run_episodes(self._task, self._policy, agent, episode_key, repeated)
            rate = jnp.mean(episodes.success.reshape(cfg.num_points, cfg.rollouts), axis=1)
            good = points.valid & (rate >= cur.r_min) & (rate <= cur.r_max)
            # Good ones move to the free rows; what does not fit is dropped.
            row = jnp.where(good, found.count() + jnp.cumsum(good) - 1, cur.num_new)
            found = jax.tree.map(
                lambda old, new: old.at[row].set(new, mode="drop"), found, dataclasses.replace(points, valid=good)
            )
            hard = points.valid & (rate < cur.r_min)
            rest = dataclasses.replace(points, valid=jnp.where(jnp.any(hard), hard, points.valid))
            return i + 1, found, rest, steps + jnp.sum(episodes.length)

        like = jax.eval_shape(lambda: self._task.sample_feasible(key, cfg.num_points))
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        empty = jax.tree.map(lambda x: jnp.zeros((cur.num_new, *x.shape[1:]), x.dtype), like)
        first = (jnp.int32(0), empty, nothing, jnp.zeros(()))
        _, found, rest, steps = jax.lax.while_loop(unfinished, search, first)
        instead = sample_starts(rest_key, rest, cur.num_new)
        new = jax.tree.map(lambda a, b: jnp.where(found.count() > 0, a, b), found, instead)
        starts = concatenate(new, sample_starts(old_key, state.replay, cur.num_old))
        return OracleState(replay=state.replay, labelling_steps=steps), starts

    def update(
        self, key: Array, state: OracleState, starts: StartSet, labels: StartLabels
    ) -> tuple[OracleState, MethodMetrics]:
        """Starts that training showed to be good enter the replay."""
        kind, metrics = classify_starts(
            self._config.curriculum,
            starts,
            labels,
            replay_size=state.replay.count(),
            proposal_steps=state.labelling_steps,
        )
        replay = append(key, state.replay, dataclasses.replace(starts, valid=kind.good))
        return OracleState(replay=replay, labelling_steps=state.labelling_steps), metrics
