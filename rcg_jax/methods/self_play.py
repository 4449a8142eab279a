"""Asymmetric self-play (Sukhbaatar et al. 2017), the comparison of section 5.2 and appendix B.3.

Alice begins at the goal, moves, and stops: where she stops is a start for Bob, the policy that learns the task. She
is paid for starts that are quick to make and slow to undo, r_A = max(0, t_B - t_A).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.curriculum.replay import append, init_replay
from rcg_jax.methods.base import MethodMetrics, classify_starts
from rcg_jax.rl.advantage import generalized_advantage
from rcg_jax.rl.agent import Agent, init_agent, make_baseline, make_policy
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.rl.hold import decisions, hold
from rcg_jax.rl.train_policy import Batch, standardized, update_agent
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, StartLabels, StartSet, concatenate, finite, sample_starts

#: (key, Alice's end states, t_A (E,)) -> (t_B (E,): how long Bob takes from there back to the goal, the longest time
#: he may take where he does not arrive; physics steps spent on that (E,)).
BobTime = Callable[[Array, StartSet, Array], tuple[Array, Array]]


@struct.dataclass
class AliceEpisodes:
    """One episode of Alice in each of E environments, a row for each action; what follows an episode's end is padding.

    Attributes:
        obs, next_obs: (L, E, obs_dim) raw observations before and after each action.
        action: (L, E, nu + 1) as sampled; the last one is the stop action.
        alive: (L, E) bool, the action belongs to the episode.
        last: (L, E) bool, the action ended it.
        length: (E,) int32, t_A [physics steps].
        proposals: E starts for Bob, where she stopped, at rest; invalid where the episode failed.
    """

    obs: Array
    next_obs: Array
    action: Array
    alive: Array
    last: Array
    length: Array
    proposals: StartSet


@struct.dataclass
class AliceStats:
    """An iteration of Alice in numbers; all scalars.

    Attributes:
        alice_steps: mean t_A of her episodes [physics steps].
        alice_reward: her mean reward max(0, t_B - t_A) [physics steps].
        alice_spread: root mean square distance of her proposals' positions from their mean [rad, m].
        steps: physics steps of her episodes and of Bob's from their ends.
    """

    alice_steps: Array
    alice_reward: Array
    alice_spread: Array
    steps: Array


def alice_episodes(task: Task, config: Config, key: Array, alice: Agent, *, num: int, horizon: int) -> AliceEpisodes:
    """``num`` episodes of Alice from the goal state, of at most ``horizon`` steps, rounded up to whole actions.

    She ends one by her stop action; the horizon ends it, too, and both propose the state. Where she leaves the
    feasible region, fails, or physics turns non-finite, nothing is proposed. All of them are stepped to the end,
    whoever stopped before.
    """
    nu = task.action_dim
    repeat = config.policy.action_repeat
    policy = make_policy(config, nu + 1, repeat)
    rows = decisions(horizon, repeat)
    Carry = tuple[PhysicsState, Array, Array, Array]

    def step(carry: Carry, x: tuple[Array, Array]) -> tuple[Carry, tuple[Array, ...]]:
        physics, obs, alive, lost = carry
        t, noise_key = x
        dist = policy(alice.policy, alice.norm(obs))
        action = dist.sample(jax.random.normal(noise_key, dist.mean.shape))
        moved, s, (lost_way, bad) = hold(
            task, physics, action[:, :nu], repeat, lambda s: task.is_failure(s) | ~task.is_feasible(s)
        )
        seen_obs, seen = finite(jax.vmap(task.observe)(s))
        out = jnp.any(lost_way | bad, axis=0) | ~seen
        stop = (jnp.tanh(action[:, nu]) > config.self_play.stop_threshold) | (t + 1 >= rows)
        last = alive & (out | stop)

        def keep(new: Array, old: Array) -> Array:
            return jnp.where(alive.reshape(alive.shape + (1,) * (new.ndim - 1)), new, old)

        after = jax.tree.map(keep, moved, physics)
        next_obs = keep(seen_obs, obs)
        return (after, next_obs, alive & ~last, lost | (alive & out)), (obs, next_obs, action, alive, last)

    index = jnp.zeros(num, jnp.int32)
    begin = task.reset(task.goal_starts().take(index))
    no = jnp.zeros(num, bool)
    carry = (begin, finite(task.observe_batch(begin))[0], ~no, no)
    xs = (jnp.arange(rows), jax.random.split(key, rows))
    (end, _, _, lost), (obs, next_obs, action, alive, last) = jax.lax.scan(step, carry, xs)
    return AliceEpisodes(
        obs=obs,
        next_obs=next_obs,
        action=action,
        alive=alive,
        last=last,
        length=repeat * jnp.sum(alive, axis=0, dtype=jnp.int32),
        proposals=StartSet(qpos=end.qpos, qvel=jnp.zeros_like(end.qvel), valid=~lost, act=end.act),
    )


def improve_alice(
    config: Config,
    key: Array,
    alice: Agent,
    *,
    episodes: AliceEpisodes,
    reward: Array,
    learn_norm: Array,
    batch: int,
) -> Agent:
    """One TRPO iteration on Alice's episodes, the same as Bob's.

    Args:
        config: settings.
        key: PRNG key.
        alice: the agent that made the episodes.
        episodes: L x E actions.
        reward: (E,) at the end of each episode.
        learn_norm: () bool, whether the observation statistics are updated.
        batch: actions to draw from the episodes, each of them equally often (up to one) where there are fewer.
    """
    repeat = config.policy.action_repeat
    trpo, baseline = config.trpo, make_baseline(config)
    obs = alice.norm(episodes.obs)
    value = baseline(alice.baseline, obs)
    next_value = baseline(alice.baseline, alice.norm(episodes.next_obs))
    at_end = jnp.where(episodes.last, reward, 0.0)
    advantage, target = generalized_advantage(
        at_end,
        value,
        next_value,
        episodes.last,
        episodes.last,
        gamma=trpo.gamma**repeat,
        lam=trpo.gae_lambda**repeat,
    )
    # Padding has no part in anything: rows are drawn in random order from those that belong to an episode.
    alive = episodes.alive.reshape(-1)
    order = jax.random.permutation(key, alive.shape[0])
    order = order[jnp.argsort(~alive[order], stable=True)]
    rows = order[jnp.arange(batch) % jnp.sum(alive)]

    def drawn(x: Array) -> Array:
        return x.reshape(-1, *x.shape[2:])[rows]

    # Without any reward the advantages are nothing but V's errors, which standardisation would blow up.
    advantage = jnp.where(jnp.any(reward > 0), standardized(drawn(advantage)), 0.0)
    raw = drawn(episodes.obs)
    drawn_batch = Batch(obs=raw, action=drawn(episodes.action), advantage=advantage, target=drawn(target))
    return update_agent(config, alice, drawn_batch, learn_norm=learn_norm)[0]


def alice_iteration(
    task: Task, config: Config, key: Array, alice: Agent, *, bob_time: BobTime, learn_norm: Array
) -> tuple[Agent, StartSet, AliceStats]:
    """Alice proposes N_new starts, is paid by Bob's time from each, and improves once.

    Her reward in TRPO is in units of the horizon T, so that her V has the scale of Bob's.
    """
    run_key, bob_key, improve_key = jax.random.split(key, 3)
    horizon = config.self_play.horizon_factor * task.horizon
    episodes = alice_episodes(task, config, run_key, alice, num=config.curriculum.num_new, horizon=horizon)
    proposals, t_alice = episodes.proposals, episodes.length
    t_bob, spent = bob_time(bob_key, proposals, t_alice)
    reward = jnp.where(proposals.valid, jnp.maximum(0, t_bob - t_alice), 0).astype(jnp.float32)
    repeat = config.policy.action_repeat
    batch = config.rollout.batch_size // repeat
    after = improve_alice(
        config,
        improve_key,
        alice,
        episodes=episodes,
        reward=reward / task.horizon,
        learn_norm=learn_norm,
        batch=batch,
    )
    num = jnp.maximum(proposals.count(), 1)
    weight = proposals.valid[:, None] / num
    centre = jnp.sum(proposals.qpos * weight, axis=0)
    stats = AliceStats(
        alice_steps=jnp.mean(t_alice.astype(jnp.float32)),
        alice_reward=jnp.mean(reward),
        alice_spread=jnp.sqrt(jnp.sum(weight * (proposals.qpos - centre) ** 2)),
        steps=jnp.sum(t_alice).astype(jnp.float32) + jnp.sum(jnp.where(proposals.valid, spent, 0)),
    )
    return after, proposals, stats


@struct.dataclass
class SelfPlayMetrics(MethodMetrics):
    """Adds Alice's part, see :class:`AliceStats`."""

    alice_steps: Array
    alice_reward: Array
    alice_spread: Array


@struct.dataclass
class SelfPlayState:
    """What self-play carries on.

    Attributes:
        alice: her policy, baseline and statistics.
        iterations: () int32, how often she was improved.
        replay: starts_old.
        stats: about her last iteration.
    """

    alice: Agent
    iterations: Array
    replay: StartSet
    stats: AliceStats


class SelfPlay:
    """N_new starts where Alice stops, and N_old of the replay."""

    def __init__(self, task: Task, config: Config) -> None:
        """Self-play on ``task``; works on every task."""
        self._task = task
        self._config = config
        self._bob = make_policy(config, task.action_dim, config.policy.action_repeat)

    def init(self, key: Array) -> SelfPlayState:
        """A fresh Alice; the replay holds [s^g]."""
        zero = jnp.zeros(())
        # Her last action is none of the task's; with less noise she would hardly ever stop.
        std = np.append(np.full(self._task.action_dim, self._config.policy.init_std), 1.0)
        return SelfPlayState(
            alice=init_agent(self._config, key, self._task.obs_dim, self._task.action_dim + 1, std),
            iterations=jnp.int32(0),
            replay=init_replay(self._task.goal_starts(), self._config.curriculum.replay_capacity),
            stats=AliceStats(alice_steps=zero, alice_reward=zero, alice_spread=zero, steps=zero),
        )

    def propose(self, key: Array, state: SelfPlayState, agent: Agent) -> tuple[SelfPlayState, StartSet]:
        """Alice's end states, each timed by one stochastic episode of Bob; then the replay.

        Bob has what Alice left of the horizon they share, at least 5 steps.
        """
        cfg = self._config
        alice_key, old_key = jax.random.split(key)
        shared = cfg.self_play.horizon_factor * self._task.horizon

        def bob_time(key: Array, starts: StartSet, t_alice: Array) -> tuple[Array, Array]:
            limit = jnp.maximum(5, shared - t_alice)
            bob = run_episodes(self._task, self._bob, agent, key, starts, horizon=limit)
            # A failure that ends an episode early is no way home.
            return jnp.where(bob.success, bob.length, limit), bob.length

        learn_norm = state.iterations < cfg.policy.obs_norm_iterations
        alice, new, stats = alice_iteration(
            self._task, cfg, alice_key, state.alice, bob_time=bob_time, learn_norm=learn_norm
        )
        old = sample_starts(old_key, state.replay, cfg.curriculum.num_old)
        starts = concatenate(new, old)
        # With all proposals lost and no replay drawn there would be nothing to train on.
        goal = self._task.goal_starts().take(jnp.zeros(starts.capacity, jnp.int32))
        starts = jax.tree.map(lambda a, b: jnp.where(starts.count() > 0, a, b), starts, goal)
        after = SelfPlayState(alice=alice, iterations=state.iterations + 1, replay=state.replay, stats=stats)
        return after, starts

    def update(
        self, key: Array, state: SelfPlayState, starts: StartSet, labels: StartLabels
    ) -> tuple[SelfPlayState, SelfPlayMetrics]:
        """Starts that training showed to be good enter the replay."""
        stats = state.stats
        kind, metrics = classify_starts(
            self._config.curriculum, starts, labels, replay_size=state.replay.count(), proposal_steps=stats.steps
        )
        replay = append(key, state.replay, dataclasses.replace(starts, valid=kind.good))
        common = {item.name: getattr(metrics, item.name) for item in dataclasses.fields(metrics)}  # type: ignore[arg-type]
        return dataclasses.replace(state, replay=replay), SelfPlayMetrics(
            **common,
            alice_steps=stats.alice_steps,
            alice_reward=stats.alice_reward,
            alice_spread=stats.alice_spread,
        )
