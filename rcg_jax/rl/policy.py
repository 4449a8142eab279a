"""Gaussian MLP policy (paper, appendix A.1) and the normalisation of its observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rcg_jax.rl.masked import masked_mean

#: Observations are divided by the square root of their variance plus this, and clipped to so many standard deviations.
OBS_EPSILON, OBS_CLIP = 1e-6, 10.0


class MLP(nn.Module):
    """tanh multi-layer perceptron with a linear output layer.

    Attributes:
        hidden: widths of the hidden layers.
        out: outputs.
        gain: factor on the output layer's initial weights.
    """

    hidden: Sequence[int]
    out: int
    gain: float = 1.0

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.hidden:
            x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.xavier_uniform())(x))
        last = nn.initializers.zeros
        if self.gain:
            last = nn.initializers.variance_scaling(self.gain**2, "fan_avg", "uniform")
        return nn.Dense(self.out, kernel_init=last)(x)


@struct.dataclass
class Gaussian:
    """Diagonal Gaussians over actions: mean (..., nu), log_std (nu,) shared by all."""

    mean: Array
    log_std: Array

    def sample(self, noise: Array) -> Array:
        """Actions for standard normal ``noise`` of the mean's shape."""
        return self.mean + jnp.exp(self.log_std) * noise

    def log_prob(self, action: Array) -> Array:
        """Log density of actions (..., nu), (...)."""
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return -0.5 * jnp.sum(z * z, axis=-1) - jnp.sum(self.log_std) - 0.5 * self.log_std.size * jnp.log(2 * jnp.pi)

    def kl(self, other: Gaussian) -> Array:
        """KL(self || other) per state, (...)."""
        ratio = jnp.exp(2.0 * (self.log_std - other.log_std))
        shift = ((self.mean - other.mean) * jnp.exp(-other.log_std)) ** 2
        return jnp.sum(0.5 * (ratio + shift - 1.0) + other.log_std - self.log_std, axis=-1)

    def entropy(self) -> Array:
        """Differential entropy, ()."""
        return jnp.sum(self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))


@struct.dataclass
class PolicyParams:
    """What TRPO optimises.

    Attributes:
        mlp: parameters of the mean network.
        log_std: (nu,).
    """

    mlp: Any
    log_std: Array


class GaussianPolicy:
    """pi_theta(a | s): tanh MLP mean, state-independent standard deviation. Pure; parameters are passed in."""

    def __init__(
        self,
        action_dim: int,
        *,
        hidden: Sequence[int],
        learn_std: bool,
        output_gain: float,
        action_repeat: int = 1,
    ) -> None:
        """pi with actions (action_dim,).

        Args:
            action_dim: nu.
            hidden: widths of the hidden layers.
            learn_std: whether the standard deviation has a gradient.
            output_gain: factor on the output layer's initial weights.
            action_repeat: k, physics steps that each action is held for.
        """
        self.action_repeat = action_repeat
        self._net = MLP(tuple(hidden), action_dim, output_gain)
        self._action_dim = action_dim
        self._learn_std = learn_std

    def init(self, key: Array, obs_dim: int, std: float | np.ndarray = 1.0) -> PolicyParams:
        """Fresh parameters for observations of length ``obs_dim``, with standard deviation ``std``, of each or all."""
        log_std = jnp.asarray(np.broadcast_to(np.log(std), self._action_dim), jnp.float32)
        return PolicyParams(mlp=self._net.init(key, jnp.zeros(obs_dim)), log_std=log_std)

    def __call__(self, params: PolicyParams, obs: Array) -> Gaussian:
        """Action distributions for normalised observations (..., obs_dim)."""
        log_std = params.log_std if self._learn_std else jax.lax.stop_gradient(params.log_std)
        mean: Any = self._net.apply(params.mlp, obs)
        return Gaussian(mean=mean, log_std=log_std)


@struct.dataclass
class ObsNormalizer:
    """Running mean and variance of observations.

    An update changes what the policy does with an observation, outside TRPO's trust region; the statistics settle
    within the first iterations and are then frozen.

    Attributes:
        count: (), observations seen.
        mean: (obs_dim,).
        var: (obs_dim,).
    """

    count: Array
    mean: Array
    var: Array

    @classmethod
    def init(cls, obs_dim: int) -> ObsNormalizer:
        """The identity, until something is observed."""
        return cls(count=jnp.zeros(()), mean=jnp.zeros(obs_dim), var=jnp.ones(obs_dim))

    def __call__(self, obs: Array) -> Array:
        """Normalised observations, clipped to :data:`OBS_CLIP` standard deviations."""
        return jnp.clip((obs - self.mean) / jnp.sqrt(self.var + OBS_EPSILON), -OBS_CLIP, OBS_CLIP)

    def update(self, obs: Array, mask: Array | None = None) -> ObsNormalizer:
        """Statistics with the observations (..., obs_dim) that ``mask`` (...) has added (Chan et al.'s update)."""
        obs = obs.reshape(-1, obs.shape[-1])
        n = float(obs.shape[0]) if mask is None else jnp.sum(mask, dtype=jnp.float32)
        mean = masked_mean(obs, mask)
        var = jnp.var(obs, axis=0) if mask is None else masked_mean((obs - mean) ** 2, mask)
        total = self.count + n
        delta = mean - self.mean
        # The identity that the statistics begin with has count 0 and leaves no trace.
        merged = (self.count * self.var + n * var + delta**2 * self.count * n / total) / total
        return ObsNormalizer(count=total, mean=self.mean + delta * n / total, var=merged)


@struct.dataclass
class Actor:
    """What acts: all that a trained policy is.

    Attributes:
        policy: parameters of pi.
        norm: observation statistics.
    """

    policy: PolicyParams
    norm: ObsNormalizer
