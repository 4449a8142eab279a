"""starts_old: the replay of earlier good starts, against forgetting (section 4.3)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.types import StartSet, sample_rows


def init_replay(starts: StartSet, capacity: int) -> StartSet:
    """A replay of the given capacity that holds ``starts``; in Algorithm 1 that is [s^g]."""

    def pad(x: Array) -> Array:
        return jnp.zeros((capacity, *x.shape[1:]), x.dtype).at[: x.shape[0]].set(x)

    return jax.tree.map(pad, starts)


def append(key: Array, replay: StartSet, starts: StartSet) -> StartSet:
    """Replay with the valid ``starts`` added. When it is full, each takes the place of a random old one.

    Args:
        key: PRNG key.
        replay: capacity R, filled from row 0 on.
        starts: capacity C <= R; only valid rows are added.
    """
    rank = jnp.cumsum(starts.valid) - 1
    slot = replay.count() + rank
    # Old rows only, each once: no new start takes the place of another new one.
    victims = sample_rows(key, replay, starts.capacity)
    slot = jnp.where(slot < replay.capacity, slot, victims[slot - replay.capacity])
    slot = jnp.where(starts.valid, slot, replay.capacity)  # out of bounds: dropped
    return jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), replay, starts)


def distinct(replay: StartSet, starts: StartSet, distance: float) -> StartSet:
    """``starts`` without those that are too close to the replay, or to one before them.

    Args:
        replay: capacity R.
        starts: capacity C.
        distance: Euclidean, between positions [rad, m], that a start must exceed.
    """

    def step(taken: StartSet, row: StartSet) -> tuple[StartSet, Array]:
        def nearest(pool: StartSet) -> Array:
            squared = jnp.sum((pool.qpos - row.qpos) ** 2, axis=-1)
            return jnp.min(jnp.where(pool.valid, squared, jnp.inf))

        new = row.valid & (jnp.minimum(nearest(replay), nearest(taken)) > distance**2)
        free = taken.count()
        taken = jax.tree.map(lambda old, x: old.at[free].set(jnp.where(new, x, old[free])), taken, row)
        return taken, new

    nothing = jax.tree.map(jnp.zeros_like, starts)
    _, new = jax.lax.scan(step, nothing, starts)
    return dataclasses.replace(starts, valid=new)
