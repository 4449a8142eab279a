"""Baseline V(s): an MLP fitted to returns with Adam (paper, appendix A.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from rcg_jax.rl.policy import MLP
from rcg_jax.sharding.devices import over_devices


@struct.dataclass
class BaselineState:
    """Parameters of V and the state of their optimiser."""

    params: Any
    opt_state: optax.OptState


class Baseline:
    """V_phi(s). Pure; the state is passed in."""

    def __init__(
        self,
        *,
        hidden: Sequence[int],
        epochs: int,
        minibatch_size: int,
        learning_rate: float,
    ) -> None:
        self._net = MLP(tuple(hidden), 1, 0.1)
        self._optimizer = optax.adam(learning_rate)
        self._epochs = epochs
        self._minibatch_size = minibatch_size

    def init(self, key: Array, obs_dim: int) -> BaselineState:
        """Fresh state for observations of length ``obs_dim``."""
        params = self._net.init(key, jnp.zeros(obs_dim))
        return BaselineState(params=params, opt_state=self._optimizer.init(params))

    def __call__(self, state: BaselineState, obs: Array) -> Array:
        """Values (...,) of normalised observations (..., obs_dim)."""
        return self._value(state.params, obs)

    def _value(self, params: Any, obs: Array) -> Array:
        out: Any = self._net.apply(params, obs)
        return out[..., 0]

    def fit(
        self, state: BaselineState, obs: Array, target: Array, count: Array | None = None, least: int | None = None
    ) -> BaselineState:
        """Regression of ``target`` (B,) on ``obs`` (B, obs_dim) in minibatches.

        Args:
            state: current state.
            obs: samples in random order; what does not fill a last minibatch is left out.
            target: returns.
            count: () int32, only the first so many samples count; None: all. Minibatches hold no others.
            least: the least value of ``count`` (static), so that there is a minibatch.
        """
        size = min(self._minibatch_size, least or obs.shape[0])
        num = obs.shape[0] // size
        batches = (
            over_devices(obs[: num * size].reshape(num, size, -1), axis=1),
            over_devices(target[: num * size].reshape(num, size), axis=1),
        )

        def loss(params: Any, x: Array, y: Array) -> Array:
            return jnp.mean((self._value(params, x) - y) ** 2)

        def step(state: BaselineState, batch: tuple[Array, Array]) -> tuple[BaselineState, None]:
            updates, opt_state = self._optimizer.update(jax.grad(loss)(state.params, *batch), state.opt_state)
            return BaselineState(params=optax.apply_updates(state.params, updates), opt_state=opt_state), None

        # Of whole episodes there may be more minibatches than samples fill; those are skipped, Adam's momentum too.
        full = num if count is None else count // size

        def step_if_full(state: BaselineState, x: tuple[Array, tuple[Array, Array]]) -> tuple[BaselineState, None]:
            after = step(state, x[1])[0]
            return jax.tree.map(lambda new, old: jnp.where(x[0] < full, new, old), after, state), None

        def epoch(state: BaselineState, _: None) -> tuple[BaselineState, None]:
            if count is None:
                return jax.lax.scan(step, state, batches)[0], None
            return jax.lax.scan(step_if_full, state, (jnp.arange(num), batches))[0], None

        return jax.lax.scan(epoch, state, None, length=self._epochs)[0]
