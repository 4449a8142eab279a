"""One action held for several steps of physics: between two of them the policy does not decide anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, Snapshot

Seen = TypeVar("Seen")


def hold(
    task: Task, state: PhysicsState, action: Array, repeat: int, look: Callable[[Snapshot], Seen]
) -> tuple[PhysicsState, Snapshot, tuple[Seen, Array]]:
    """``repeat`` steps under one action.

    Args:
        task: task and physics.
        state: B simulations.
        action: (B, nu), as :meth:`rcg_jax.tasks.base.Task.step` takes it.
        repeat: k, steps (static).
        look: what to keep of every state on the way.

    Returns:
        The state after the last step with its kinematics; then, of every step, what ``look`` gave, leaves (k, B, ...),
        and whether physics had turned non-finite, (k, B).
    """
    states = task.steps(state, action, repeat)
    num = repeat * action.shape[0]
    s = task.snapshot(jax.tree.map(lambda x: x.reshape(num, *x.shape[2:]), states))

    def of_each_step(x: Array) -> Array:
        return x.reshape(action.shape[0], repeat, *x.shape[1:])  # not -1: a model may have no sites

    seen = jax.tree.map(lambda x: jnp.moveaxis(of_each_step(x), 1, 0), (jax.vmap(look)(s), states.bad.reshape(num)))
    last = jax.tree.map(lambda x: of_each_step(x)[:, -1], s)
    return jax.tree.map(lambda x: x[:, -1], states), last, seen


def active_mask(ended: Array, room: Array) -> Array:
    """Which steps under one action belong to the episode: those up to its end, or until its time is up.

    Args:
        ended: (k, B) bool, the episode ends with this step, if it had not before.
        room: (B,) int32, steps that are left to it.

    Returns:
        (k, B) bool.
    """
    earlier = jnp.cumsum(ended, axis=0) - ended
    return (earlier == 0) & (jnp.arange(ended.shape[0])[:, None] < room)


def decisions(steps: int, repeat: int) -> int:
    """How many actions, each held for ``repeat`` steps, it takes to fill so many steps."""
    return -(-steps // repeat)
