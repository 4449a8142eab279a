"""Which states at rest stay feasible when nothing moves them: only those are starts (S^0, section 3.3)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, StartSet, finite


def settle(task: Task, starts: StartSet, steps: int) -> tuple[Array, Array]:
    """Lets states go at rest under the neutral action of each (:meth:`Task.neutral_action`).

    Args:
        task: task and physics.
        starts: capacity C; the outcome of invalid rows means nothing.
        steps: physics steps (static).

    Returns:
        stays (C,) bool: feasible, not failed and finite all the time; drift (C,): largest change of one of the task's
        grid coordinates [rad, m].
    """
    Carry = tuple[PhysicsState, Array, Array]
    begin, neutral = task.grid_coordinates(starts.qpos), task.neutral_action(starts.qpos)

    def step(carry: Carry, _: None) -> tuple[Carry, None]:
        physics, stays, drift = carry
        physics = task.step(physics, neutral)
        s = task.snapshot(physics)
        stays &= jax.vmap(task.is_feasible)(s) & ~jax.vmap(task.is_failure)(s) & ~physics.bad
        moved = jnp.abs(task.grid_coordinates(physics.qpos) - begin)
        return (physics, stays, jnp.maximum(drift, jnp.max(moved, axis=-1))), None

    physics = task.reset(starts)
    stays = jax.vmap(task.is_feasible)(task.snapshot(physics)) & visible(task, starts)
    (_, stays, drift), _ = jax.lax.scan(step, (physics, stays, jnp.zeros(starts.capacity)), length=steps)
    return stays, drift


def visible(task: Task, starts: StartSet) -> Array:
    """Whether observation and distance of each start are finite, (C,) bool: an episode from another one learns nothing.

    The task's functions may leave their domain somewhere, by rounding, say.
    """
    s = task.snapshot(task.reset(starts))
    return finite(jax.vmap(task.observe)(s))[1] & finite(jax.vmap(task.distance)(s)[:, None])[1]


def num_settle_candidates(task: Task, num: int) -> int:
    """How many states to choose so that about ``num`` of them stay: as many where the task asks for nothing."""
    return 2 * num if task.settle_steps else num


def settled(task: Task, starts: StartSet, num: int) -> StartSet:
    """The first ``num`` of the starts that stay for ``task.settle_steps``, in their order.

    A walk passes through states that are no starts of S^0: an ant in the middle of a tumble falls from there unless it
    does something. Training on them is training for what is never asked.

    Args:
        task: task and physics.
        starts: capacity C, see :func:`num_settle_candidates`.
        num: N.

    Returns:
        A StartSet of capacity N. Where fewer stay they are repeated; where none does its rows are invalid.
    """
    if not task.settle_steps:
        chosen = starts.take(jnp.arange(num))
        return dataclasses.replace(chosen, valid=chosen.valid & visible(task, chosen))
    stays, _ = settle(task, starts, task.settle_steps)
    stays &= starts.valid
    order = jnp.argsort(~stays, stable=True)
    rows = order[jnp.arange(num) % jnp.maximum(jnp.sum(stays), 1)]
    chosen = starts.take(rows)
    return dataclasses.replace(chosen, valid=stays[rows])
