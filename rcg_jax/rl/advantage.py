"""Generalised advantage estimation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def generalized_advantage(
    reward: Array, value: Array, next_value: Array, terminal: Array, done: Array, *, gamma: float, lam: float
) -> tuple[Array, Array]:
    """Advantages and lambda-returns of L steps in N environments.

    Args:
        reward: (L, N).
        value: (L, N) V(s_t).
        next_value: (L, N) V(s_{t+1}) of the state that the step led to, before any reset.
        terminal: (L, N) bool, the episode ended for good (goal or failure): nothing follows.
        done: (L, N) bool, the episode ended here, for good or at its horizon. At the horizon V is bootstrapped.
        gamma: discount.
        lam: lambda; 1 gives discounted returns minus the baseline.

    Returns:
        advantage (L, N), and advantage + value (L, N), the regression target of the baseline.
    """
    delta = reward + gamma * jnp.where(terminal, 0.0, next_value) - value

    def step(carry: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, done = x
        carry = delta + gamma * lam * jnp.where(done, 0.0, carry)
        return carry, carry

    _, advantage = jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, done), reverse=True)
    return advantage, advantage + value
