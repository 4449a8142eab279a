"""The direction of a TRPO step: F^-1 g by conjugate gradients."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array


def conjugate_gradient(product: Callable[[Array], Array], b: Array, *, iterations: int, tol: float = 1e-10) -> Array:
    """Approximate solution x of A x = b for a symmetric positive definite A.

    Args:
        product: v -> A v, both (P,).
        b: (P,).
        iterations: at most this many products.
        tol: stops when the squared residual falls below ``tol``; b = 0 gives x = 0 exactly.

    Returns:
        x, (P,).
    """
    Carry = tuple[Array, Array, Array, Array, Array]

    def unfinished(carry: Carry) -> Array:
        i, _, _, _, rr = carry
        return (i < iterations) & (rr > tol)

    def step(carry: Carry) -> Carry:
        i, x, r, p, rr = carry
        ap = product(p)
        alpha = rr / (p @ ap)
        r = r - alpha * ap
        rr_next = r @ r
        return i + 1, x + alpha * p, r, r + (rr_next / rr) * p, rr_next

    return jax.lax.while_loop(unfinished, step, (jnp.int32(0), jnp.zeros_like(b), b, b, b @ b))[1]
