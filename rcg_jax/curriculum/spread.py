"""Picking from many points: those spread evenly over what all of them cover, and those nearest to given ones."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.types import StartSet, sample_rows


def farthest_rows(points: Array, valid: Array, first: Array, num: int) -> Array:
    """Rows of ``points``, each the farthest from those taken before it (Gonzalez' k-centre rule).

    What random walks visit is uneven: they linger in corners and where gravity takes them. Rows drawn at random are
    as uneven; these are not, and every visited place is near one of them.

    Args:
        points: (C, d) coordinates.
        valid: (C,) bool, the rows that may be taken.
        first: () int32, the row to begin with.
        num: how many (static).

    Returns:
        (num,) int32, without repetition as long as there are enough valid rows; after that, invalid rows where there
        are any. Where several are the farthest, the first of them is taken.
    """

    def take(nearest: Array, row: Array) -> Array:
        # What may not be taken stays at -1, whatever its coordinates are; what has been taken comes after it.
        squared = jnp.sum((points - points[row]) ** 2, axis=-1)
        return jnp.where(nearest >= 0, jnp.minimum(nearest, squared), nearest).at[row].set(-2.0)

    def step(nearest: Array, _: None) -> tuple[Array, Array]:
        row = jnp.argmax(nearest)
        return take(nearest, row), row

    nearest = take(jnp.where(valid, jnp.inf, -1.0), first)
    _, rows = jax.lax.scan(step, nearest, length=num - 1)
    return jnp.concatenate([first[None], rows])


def spread_starts(key: Array, starts: StartSet, points: Array, num: int) -> StartSet:
    """``num`` of the starts, spread evenly over what they cover of the coordinates ``points`` (C, d).

    The first is drawn uniformly, the others are :func:`farthest_rows`.
    """
    first = sample_rows(key, starts, 1)[0]
    return starts.take(farthest_rows(points, starts.valid, first, num))


def nearest_rows(points: Array, valid: Array, targets: Array) -> Array:
    """For each target in turn the nearest row of ``points`` that none before it has taken.

    Args:
        points: (C, d) coordinates.
        valid: (C,) bool, the rows that may be taken.
        targets: (N, d).

    Returns:
        (N,) int32, without repetition; once all valid rows are taken, invalid ones, and after those taken ones.
    """

    def step(kind: Array, target: Array) -> tuple[Array, Array]:
        squared = jnp.sum((points - target) ** 2, axis=-1)
        # 0: free, 1: invalid, 2: taken; of the first of these kinds that there is the nearest. Whatever the coordinates
        # of its rows are, they come before those of other kinds.
        most = float(jnp.finfo(squared.dtype).max)
        finite = jnp.nan_to_num(squared, nan=most, posinf=most)
        row = jnp.argmin(jnp.where(kind == jnp.min(kind), finite, jnp.inf))
        return kind.at[row].set(2), row

    return jax.lax.scan(step, jnp.where(valid, 0, 1), targets)[1]
