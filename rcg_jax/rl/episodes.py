"""Whole episodes of a policy, one from each of given starts: for evaluation, labels and Bob's time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.rl.agent import Agent
from rcg_jax.rl.hold import active_mask, hold
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, Snapshot, StartSet, finite


@struct.dataclass
class Episodes:
    """Outcome of one episode from each of B starts.

    Attributes:
        success: (B,) bool, the goal was reached in time.
        length: (B,) int32, physics steps until the goal, a failure, or the horizon.
        bad: (B,) bool, ended by non-finite physics, observations or distances.
    """

    success: Array
    length: Array
    bad: Array


@struct.dataclass
class Disturbance:
    """What lies between a policy and the robot it meets, for each of B episodes.

    Attributes:
        key: PRNG key of the noise.
        noise: (B,) standard deviation of the noise in what the policy sees; 1: that of the observations in training.
        delay: (B,) int32, actions that each action arrives late; until the first one there is the neutral action.
        longest: the greatest delay (static).
    """

    key: Array
    noise: Array
    delay: Array
    longest: int = struct.field(pytree_node=False)


def run_episodes(
    task: Task,
    policy: GaussianPolicy,
    agent: Agent | Actor,
    key: Array,
    starts: StartSet,
    *,
    deterministic: Array | bool = False,
    horizon: Array | int | None = None,
    disturbance: Disturbance | None = None,
) -> Episodes:
    """One episode from each start; stops early when all have ended.

    Args:
        task: task and physics.
        policy: pi; its actions are held for ``policy.action_repeat`` steps each.
        agent: its parameters and observation statistics.
        key: PRNG key of the action noise.
        starts: B starts; of invalid rows nothing is simulated that counts (length 0).
        deterministic: (B,) bool, act by the policy's mean there.
        horizon: (B,) or () physics steps an episode may take; the task's T by default.
        disturbance: noise and delay, none by default.
    """
    Carry = tuple[Array, PhysicsState, Array, Array, Array, Array, Array, Array | None]
    noise_scale = jnp.where(jnp.broadcast_to(jnp.asarray(deterministic), (starts.capacity,)), 0.0, 1.0)[:, None]
    limit = jnp.broadcast_to(jnp.asarray(task.horizon if horizon is None else horizon, jnp.int32), (starts.capacity,))

    def unfinished(carry: Carry) -> Array:
        return jnp.any(carry[5])

    def outcome(s: Snapshot) -> tuple[Array, Array, Array]:
        return task.is_goal(s), task.is_failure(s), finite(task.distance(s)[None])[1]

    def step(carry: Carry) -> Carry:
        t, physics, obs, success, bad, alive, length, late = carry
        seen = agent.norm(obs)
        if disturbance is not None:
            sensor_noise = jax.random.normal(jax.random.fold_in(disturbance.key, t), seen.shape)
            seen += disturbance.noise[:, None] * sensor_noise
        dist = policy(agent.policy, seen)
        noise = jax.random.normal(jax.random.fold_in(key, t), dist.mean.shape)
        action = dist.sample(noise * noise_scale)
        if disturbance is not None and late is not None:
            late = jnp.concatenate([action[None], late[:-1]])
            action = late[disturbance.delay, jnp.arange(starts.capacity)]
        physics, s, ((goal, failure, known), broken) = hold(task, physics, action, policy.action_repeat, outcome)
        obs, visible = finite(jax.vmap(task.observe)(s))
        broken = broken | ~known
        broken = broken.at[-1].set(broken[-1] | ~visible)  # as in training
        goal &= ~broken
        ended = goal | failure | broken
        live = active_mask(ended, limit - length) & alive
        success |= jnp.any(live & goal, axis=0)
        bad |= jnp.any(live & broken, axis=0)
        length += jnp.sum(live, axis=0, dtype=jnp.int32)
        alive &= ~jnp.any(live & ended, axis=0) & (length < limit)
        return t + 1, physics, obs, success, bad, alive, length, late

    none = jnp.zeros(starts.capacity, bool)
    alive = starts.valid & (limit > 0)
    physics = task.reset(starts)
    s = task.snapshot(physics)
    obs, seen = finite(jax.vmap(task.observe)(s))
    seen &= finite(jax.vmap(task.distance)(s)[:, None])[1]
    length = jnp.zeros(starts.capacity, jnp.int32)
    late = None
    if disturbance is not None:
        waiting = task.neutral_action(starts.qpos)
        late = jnp.broadcast_to(waiting, (disturbance.longest + 1, *waiting.shape))
    carry = (jnp.int32(0), physics, obs, none, alive & ~seen, alive & seen, length, late)
    _, _, _, success, bad, _, length, _ = jax.lax.while_loop(unfinished, step, carry)
    return Episodes(success=success, length=length, bad=bad)
