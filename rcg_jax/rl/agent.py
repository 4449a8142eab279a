"""What the policy optimisation learns, and how a configuration describes it."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from flax import struct
from jax import Array

from rcg_jax.config.settings import Config
from rcg_jax.rl.baseline import Baseline, BaselineState
from rcg_jax.rl.policy import Actor, GaussianPolicy, ObsNormalizer, PolicyParams
from rcg_jax.rl.ppo import ppo_optimizer


@struct.dataclass
class Agent:
    """Everything the policy optimisation learns.

    Attributes:
        policy: parameters of pi.
        baseline: parameters of V and its optimiser.
        norm: observation statistics.
        optimizer: state of the policy's optimiser, with algorithm=ppo.
    """

    policy: PolicyParams
    baseline: BaselineState
    norm: ObsNormalizer
    optimizer: Any = None

    @property
    def actor(self) -> Actor:
        """The part that acts."""
        return Actor(policy=self.policy, norm=self.norm)


def make_policy(config: Config, action_dim: int, action_repeat: int = 1) -> GaussianPolicy:
    """The policy that ``config`` describes, with actions (action_dim,).

    ``action_repeat`` is how long each is held : it matters to what acts.
    """
    cfg = config.policy
    return GaussianPolicy(
        action_dim,
        hidden=cfg.hidden,
        learn_std=cfg.learn_std,
        output_gain=cfg.output_gain,
        action_repeat=action_repeat,
    )


def make_baseline(config: Config, action_repeat: int = 1) -> Baseline:
    """The baseline that ``config`` describes; ``action_repeat`` matters to what fits it."""
    cfg = config.baseline
    return Baseline(
        hidden=cfg.hidden,
        epochs=cfg.epochs,
        minibatch_size=max(1, cfg.minibatch_size // action_repeat),
        learning_rate=cfg.learning_rate,
    )


def init_agent(
    config: Config, key: Array, obs_dim: int, action_dim: int, init_std: float | np.ndarray | None = None
) -> Agent:
    """A fresh agent for observations (obs_dim,) and actions (action_dim,).

    ``init_std`` is the policy's initial standard deviation, of all actions or each; None: that of ``config``.
    """
    policy_key, baseline_key = jax.random.split(key)
    policy = make_policy(config, action_dim).init(
        policy_key, obs_dim, config.policy.init_std if init_std is None else init_std
    )
    return Agent(
        policy=policy,
        baseline=make_baseline(config).init(baseline_key, obs_dim),
        norm=ObsNormalizer.init(obs_dim),
        optimizer=ppo_optimizer(config.ppo).init(policy) if config.algorithm == "ppo" else None,
    )
