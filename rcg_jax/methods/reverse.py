"""The paper's method: grow the starts backwards from the goal (Algorithm 1), and its ablation all_starts."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.curriculum.replay import append, init_replay
from rcg_jax.curriculum.sample_nearby import visit_nearby
from rcg_jax.curriculum.select import Difficulty
from rcg_jax.curriculum.settle import room_to_settle, settled
from rcg_jax.curriculum.spread import nearest_rows, spread_starts
from rcg_jax.methods.base import MethodMetrics, sort_starts
from rcg_jax.rl.agent import Agent, make_baseline
from rcg_jax.sharding.devices import any_of_all_seeds
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet, concatenate, finite, sample_starts


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

    def __init__(self, task: Task, config: Config, *, all_starts: bool = False) -> None:
        """A curriculum on ``task``.

        Args:
            task: task and physics.
            config: the run's settings.
            all_starts: ablation of section 5.2: select is the identity, walks begin from all starts.

        Raises:
            FileNotFoundError: starts near rho_0 are asked for, and the task has no feasible set.
            StartsFileError: its file is damaged.
        """
        self._task = task
        self._config = config.curriculum
        self._baseline = make_baseline(config)
        self._all_starts = all_starts
        share = config.curriculum.rho_0_share
        self._towards = round((task.rho_0_share if share < 0 else share) * config.curriculum.num_new)
        if self._towards and not task.has_exact_sampler():
            task.feasible_starts()  # refuses now rather than while the train step is traced

    def init(self, key: Array) -> ReverseState:
        """starts = starts_old = [s^g]."""
        goal = self._task.goal_starts()
        capacity = self._config.num_new + self._config.num_old
        return ReverseState(
            seeds=init_replay(goal, capacity),
            replay=init_replay(goal, self._config.replay_capacity),
            walk_length=jnp.float32(self._config.brownian_horizon),
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
            brownian_horizon=cfg.brownian_horizon,
            walk_length=state.walk_length.astype(jnp.int32),
            walk_rounds=cfg.walk_rounds,
            noise_std=cfg.noise_std,
            noise=cfg.noise,
        )
        new = self._choose(draw_key, visited, agent)
        starts = concatenate(new, sample_starts(old_key, state.replay, cfg.num_old))
        # Without a replay there may be none, where none settles; then the goal state, so that the walks go on from it.
        goal = self._task.goal_starts().take(jnp.zeros(starts.capacity, jnp.int32))
        return state, jax.tree.map(lambda a, b: jnp.where(starts.count() > 0, a, b), starts, goal)

    def _choose(self, key: Array, visited: StartSet, agent: Agent) -> StartSet:
        """The N_new starts among those visited.

        The paper draws them uniformly. Then most of them lie where walks linger, and hardly one where the success rate
        falls from 1 to 0, which may be a short stretch: a corner of a maze, the moment when a key comes out of its
        lock. Therefore a part is spread evenly over the positions, and a part over the values V(s), which fall there.
        Before both comes the part that is nearest to rho_0, where there is one.
        """
        cfg = self._config
        parts = []
        if self._towards:
            rho_key, key = jax.random.split(key)
            parts.append(self._towards_rho_0(rho_key, visited, agent, self._towards))
        rest = cfg.num_new - self._towards
        if rest and cfg.selection == "random":
            drawn = sample_starts(key, visited, room_to_settle(self._task, rest))
            parts.append(settled(self._task, drawn, rest))
        elif rest:
            value_key, position_key = jax.random.split(key)
            by_value = round(cfg.value_share * rest)
            if by_value:
                value = self._baseline(agent.baseline, self._seen(visited, agent))
                parts.append(self._spread(value_key, visited, value[:, None], by_value))
            if rest > by_value:
                positions = self._task.grid_coordinates(visited.qpos)
                parts.append(self._spread(position_key, visited, positions, rest - by_value))
        return concatenate(*parts)

    def _spread(self, key: Array, visited: StartSet, points: Array, num: int) -> StartSet:
        """``num`` of those visited, spread over the coordinates ``points`` (C, d)."""
        return settled(self._task, spread_starts(key, visited, points, room_to_settle(self._task, num)), num)

    def _towards_rho_0(self, key: Array, visited: StartSet, agent: Agent, num: int) -> StartSet:
        """Of those visited the nearest to each of ``num`` draws of rho_0, as the policy sees both.

        What walks visit most is what is easy to visit. Most of rho_0 is further than they have got, and its draws there
        take states at the edge of what is visited; and they take the poses that rho_0 has, however seldom a walk meets
        them. Near is a straight line through the observations: behind a wall it need not be the edge that one gets on
        from, as just before a corner of a maze; the starts that are spread find that.
        """
        more = room_to_settle(self._task, num)
        targets = self._task.sample_feasible(key, more)
        rows = nearest_rows(self._seen(visited, agent), visited.valid, self._seen(targets, agent))
        return settled(self._task, visited.take(rows), num)

    def _seen(self, starts: StartSet, agent: Agent) -> Array:
        """Normalised observations of starts at rest, (C, obs_dim)."""
        return agent.norm(finite(self._task.observe_batch(self._task.reset(starts)))[0])

    def update(
        self, key: Array, state: ReverseState, starts: StartSet, labels: StartLabels
    ) -> tuple[ReverseState, MethodMetrics]:
        """select, then append to the replay. The empty cases are in :meth:`_seeds`."""
        cfg = self._config
        seed_key, replay_key = jax.random.split(key)
        length = jnp.floor(state.walk_length)
        kind, metrics = sort_starts(
            cfg,
            starts,
            labels,
            brownian_horizon=length,
            replay_size=state.replay.count(),
            proposal_steps=length * -(-cfg.num_candidates // cfg.brownian_horizon)
            + self._task.settle_steps * room_to_settle(self._task, cfg.num_new),
        )
        next_length = self._next_walk_length(state.walk_length, metrics)
        if self._all_starts:
            replay = append(replay_key, state.replay, starts)
            return ReverseState(seeds=starts, replay=replay, walk_length=next_length), metrics
        seeds, remember = self._seeds(seed_key, state, starts, labels, kind)
        if cfg.stall_walk:
            stalled = (metrics.share_good == 0) & (metrics.share_high > metrics.share_low)
            far = jax.lax.cond(any_of_all_seeds(stalled), lambda: self._far_seeds(seed_key, starts), lambda: seeds)
            seeds = jax.tree.map(lambda a, b: jnp.where(stalled, a, b), far, seeds)
            remember &= ~stalled
            far_steps = stalled * self._far_walks() * self._far_steps()
            metrics = dataclasses.replace(metrics, proposal_steps=metrics.proposal_steps + far_steps)
        after = ReverseState(
            seeds=seeds,
            replay=append(replay_key, state.replay, dataclasses.replace(starts, valid=remember)),
            walk_length=next_length,
        )
        return after, metrics

    def _seeds(
        self, key: Array, state: ReverseState, starts: StartSet, labels: StartLabels, kind: Difficulty
    ) -> tuple[StartSet, Array]:
        """Seeds of the next walks, and the mask (C,) of the starts to remember in the replay.

        Where enough starts are good, those are both. The paper is silent about the other cases:

        * few good, most mastered: those of the mastered new starts join them that take longest to the goal. The
          success rate cannot tell mastered starts apart, the time can, and it is longest at the frontier; with all of
          them, the many easy ones close to the goal would hold the curriculum back. Without any, all starts are seeds.
        * few good, most too hard: starts of the replay join as seeds.

        With ``stall_walk`` none good and most mastered is another case, as in the authors' code: :meth:`_far_seeds`.
        """
        cfg = self._config
        is_new = jnp.arange(starts.capacity) < cfg.num_new
        good, low, high = jnp.sum(kind.good), jnp.sum(kind.low), jnp.sum(kind.high)
        few = good <= cfg.min_good * (good + low + high)
        advance = few & (high > low)
        mastered = kind.high & is_new
        time = jnp.where(mastered, labels.time_to_goal, -1.0)
        slowest = jnp.ceil(cfg.outward_share * jnp.sum(mastered))
        rank = jnp.argsort(jnp.argsort(-time, stable=True), stable=True)
        remember = kind.good | (advance & mastered & (rank < slowest))
        mask = jnp.where(advance & ~jnp.any(remember), starts.valid, remember)
        old = sample_starts(key, state.replay, starts.capacity)
        retreat = few & ~(high > low)
        # Good starts stay in their rows; replayed ones fill the other rows.
        seeds = jax.tree.map(
            lambda a, b: jnp.where((retreat & ~mask).reshape(-1, *(1,) * (a.ndim - 1)), b, a),
            dataclasses.replace(starts, valid=mask),
            old,
        )
        return seeds, remember

    def _far_steps(self) -> int:
        """Steps of a walk out of a stalled curriculum."""
        return self._config.stall_walk * self._task.horizon

    def _far_walks(self) -> int:
        """How many of them visit M states."""
        return -(-self._config.num_candidates // self._far_steps())

    def _far_seeds(self, key: Array, starts: StartSet) -> StartSet:
        """N_new states that long walks from ``starts`` visited, with ten times the variance; of their capacity."""
        cfg = self._config
        walk_key, draw_key = jax.random.split(key)
        visited = visit_nearby(
            self._task,
            walk_key,
            starts,
            num_candidates=cfg.num_candidates,
            brownian_horizon=self._far_steps(),
            walk_length=self._far_steps(),
            walk_rounds=1,
            noise_std=cfg.noise_std * 10**0.5,
            noise=cfg.noise,
        )
        seeds = sample_starts(draw_key, visited, starts.capacity)
        return dataclasses.replace(seeds, valid=seeds.valid & (jnp.arange(starts.capacity) < cfg.num_new))

    def _next_walk_length(self, length: Array, metrics: MethodMetrics) -> Array:
        """T_B grows while most starts are mastered and shrinks while most are too hard, within its bounds.

        Where an episode can fail, chance failures keep even easy starts from being mastered, and walks would stay short
        for ever. There T_B grows while hardly any start is too hard, too.
        """
        cfg = self._config
        easy = metrics.share_high > 0.7
        if self._task.can_fail():
            easy |= (metrics.labelled > 0) & (metrics.share_low < 0.1)
        factor = jnp.where(easy, 1.3, jnp.where(metrics.share_low > 0.5, 1 / 1.3, 1.0))
        return jnp.clip(length * factor, cfg.brownian_horizon, cfg.brownian_horizon_max)
