"""PRNG keys in pytrees, which files and other processes know as plain numbers only."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def is_key(leaf: Any) -> bool:
    """Whether an array, or its shape and type, is of typed keys."""
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def key_data(tree: Any) -> Any:
    """``tree`` with the numbers of its keys in place of the keys."""
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree)


def wrap_keys(data: Any, like: Any) -> Any:
    """The inverse of :func:`key_data`; ``like`` has keys of the same generators, and may be shapes and types only."""

    def wrap(old: Any, leaf: Any) -> Any:
        return jax.random.wrap_key_data(jnp.asarray(leaf), impl=_generator(old)) if is_key(old) else leaf

    return jax.tree.map(wrap, like, data)


def _generator(key: Any) -> Any:
    """That of a key, which may be only a shape: ``jax.random.key_impl`` asks for an array."""
    found: list[Any] = []
    jax.eval_shape(lambda traced: found.append(jax.random.key_impl(traced)), key)
    return found[0]
