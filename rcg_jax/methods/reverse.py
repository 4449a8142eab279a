"""The paper's method: grow the starts backwards from the goal (Algorithm 1), and its ablation all_starts.

Beside the paper there are :mod:`rcg_jax.curriculum.choose` (which of the visited states become new starts) and
:mod:`rcg_jax.curriculum.growth` (the next seeds, T_B). ``preset=paper`` uses their plain form: uniform draws, a fixed
T_B, the good starts as seeds. Where no start is good the paper is silent: then, if most are mastered, long walks as in
the authors' code (``stall_walk``), else the replay.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.curriculum.choose import Value, choose_starts, num_towards_rho_0
from rcg_jax.curriculum.growth import next_seeds, next_walk_length
from rcg_jax.curriculum.replay import append, distinct, init_replay
from rcg_jax.curriculum.sample_nearby import visit_nearby, walk_counts
from rcg_jax.curriculum.settle import num_settle_candidates
from rcg_jax.methods.base import MethodMetrics, classify_starts
from rcg_jax.rl.agent import Agent, make_baseline
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet, concatenate, sample_starts


@struct.dataclass
class ReverseState:
    """What the curriculum carries from one iteration to the next.

    Attributes:
        seeds: the paper's ``starts`` after select: where the next walks begin. Capacity N_new + N_old.
        replay: starts_old.
        walk_length: () float32, T_B of the next walks.
    """

    seeds: StartSet
    replay: StartSet
    walk_length: Array


class Reverse:
    """SampleNearby from the good starts, with a replay of earlier ones."""

    def __init__(self, task: Task, config: Config, *, all_starts: bool = False, baseline: Value | None = None) -> None:
        """A curriculum on ``task``.

        Args:
            task: task and physics.
            config: the run's settings.
            all_starts: ablation of section 5.2: select is the identity, walks begin from all starts.
            baseline: V; by default that of ``config``.

        Raises:
            FileNotFoundError: starts near rho_0 are asked for, and the task has no feasible set.
            StartsFileError: its file is damaged.
        """
        self._task, self._config, self._all_starts = task, config.curriculum, all_starts
        self._baseline: Value = baseline or make_baseline(config)
        if num_towards_rho_0(config.curriculum) and not task.has_exact_sampler():
            task.feasible_starts()  # refuses now rather than while the train step is traced

    def init(self, key: Array) -> ReverseState:
        """starts = starts_old = [s^g]."""
        cfg, goal = self._config, self._task.goal_starts()
        return ReverseState(
            seeds=init_replay(goal, cfg.num_new + cfg.num_old),
            replay=init_replay(goal, cfg.replay_capacity),
            walk_length=jnp.float32(cfg.brownian_horizon),
        )

    def propose(self, key: Array, state: ReverseState, agent: Agent) -> tuple[ReverseState, StartSet]:
        """SampleNearby(starts, N_new), then N_old of the replay; the new ones come first."""
        cfg = self._config
        walk_key, draw_key, old_key = jax.random.split(key, 3)
        visited = visit_nearby(
            self._task,
            walk_key,
            state.seeds,
            num_candidates=cfg.num_candidates,
            num_snapshots=cfg.brownian_horizon,
            walk_length=state.walk_length.astype(jnp.int32),
            walk_rounds=cfg.walk_rounds,
            noise_std=cfg.noise_std,
            noise=cfg.noise,
        )
        new = choose_starts(cfg, self._task, draw_key, visited, agent=agent, baseline=self._baseline)
        starts = concatenate(new, sample_starts(old_key, state.replay, cfg.num_old))
        # Without a replay there may be none, where none settles; then the goal state, so that the walks go on from it.
        goal = self._task.goal_starts().take(jnp.zeros(starts.capacity, jnp.int32))
        return state, jax.tree.map(lambda a, b: jnp.where(starts.count() > 0, a, b), starts, goal)

    def update(
        self, key: Array, state: ReverseState, starts: StartSet, labels: StartLabels
    ) -> tuple[ReverseState, MethodMetrics]:
        """select, then append to the replay."""
        cfg, task = self._config, self._task
        seed_key, replay_key, stall_key = jax.random.split(key, 3)
        length = jnp.floor(state.walk_length)
        kind, metrics = classify_starts(
            cfg,
            starts,
            labels,
            brownian_horizon=length,
            replay_size=state.replay.count(),
            proposal_steps=self._proposal_steps(length),
        )
        if self._all_starts:
            seeds, remember = starts, starts.valid
        else:
            seeds, remember, steps = next_seeds(
                cfg, task, (seed_key, stall_key), state.replay, starts=starts, labels=labels, kind=kind
            )
            metrics = dataclasses.replace(metrics, proposal_steps=metrics.proposal_steps + steps)
        new = dataclasses.replace(starts, valid=remember)
        if cfg.replay_distance:
            new = distinct(state.replay, new, cfg.replay_distance)
        after = ReverseState(
            seeds=seeds,
            replay=append(replay_key, state.replay, new),
            walk_length=next_walk_length(cfg, state.walk_length, metrics, can_fail=task.can_fail()),
        )
        return after, metrics

    def _proposal_steps(self, length: Array) -> Array:
        """Physics steps of SampleNearby with walks of ``length`` steps."""
        cfg, task = self._config, self._task
        rounds, walks = walk_counts(cfg.num_candidates, cfg.brownian_horizon, cfg.walk_rounds)
        return length * (rounds * walks) + task.settle_steps * num_settle_candidates(task, cfg.num_new)
