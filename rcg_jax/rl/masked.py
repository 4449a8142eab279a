"""Means over a batch of which a mask says what belongs to it."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def masked_mean(x: Array, mask: Array | None) -> Array:
    """Mean over the leading axis of ``x`` (B, ...), of the rows that ``mask`` (B,) has; None: of all.

    What the other rows hold has no influence, NaN included.
    """
    if mask is None:
        return jnp.mean(x, axis=0)
    mask = mask.reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.sum(jnp.where(mask, x, 0.0), axis=0) / jnp.maximum(jnp.sum(mask), 1)
