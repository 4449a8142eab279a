"""What a method is: where the starts of each training iteration come from."""

from __future__ import annotations

from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config.settings import CurriculumConfig
from rcg_jax.curriculum.select import Difficulty, Shares, difficulty
from rcg_jax.rl.agent import Agent
from rcg_jax.types import StartLabels, StartSet


@struct.dataclass
class MethodMetrics(Shares):
    """What a method reports about one iteration; all scalars. Methods with more to say extend it.

    Attributes:
        share_low, share_good, share_high, labelled: see :class:`~rcg_jax.curriculum.select.Shares`.
        brownian_horizon: T_B of this iteration [physics steps]; 0 without walks.
        replay_size: starts in the replay before this iteration's were added.
        proposal_steps: physics steps spent on finding starts; ``env_steps`` does not hold them.
    """

    brownian_horizon: Array
    replay_size: Array
    proposal_steps: Array


class Method(Protocol):
    """A way to choose rho_i. Its state is a pytree of its own, opaque to everything else.

    All three functions are pure and traced into the train step: fixed shapes, no Python branches on values.
    """

    def init(self, key: Array) -> Any:
        """State before the first iteration."""
        ...

    def propose(self, key: Array, state: Any, agent: Agent) -> tuple[Any, StartSet]:
        """The starts to train on, rho_i, of constant capacity, at least one valid; and the state after choosing them.

        Args:
            key: PRNG key.
            state: the method's state.
            agent: the agent that is going to be trained on them, for methods that ask how it does.
        """
        ...

    def update(self, key: Array, state: Any, starts: StartSet, labels: StartLabels) -> tuple[Any, MethodMetrics]:
        """State after training on ``starts`` showed ``labels``, and what to report."""
        ...


def classify_starts(
    config: CurriculumConfig,
    starts: StartSet,
    labels: StartLabels,
    *,
    brownian_horizon: Array | float = 0.0,
    replay_size: Array | int = 0,
    proposal_steps: Array | float = 0.0,
) -> tuple[Difficulty, MethodMetrics]:
    """Which of ``starts`` are too hard, good and mastered, and the metrics that say so."""
    kind = difficulty(starts, labels, r_min=config.r_min, r_max=config.r_max, min_episodes=config.min_episodes)
    low, good, high = (jnp.sum(mask) for mask in (kind.low, kind.good, kind.high))
    known = low + good + high
    num = jnp.maximum(known, 1)
    return kind, MethodMetrics(
        share_low=low / num,
        share_good=good / num,
        share_high=high / num,
        labelled=known / jnp.maximum(starts.count(), 1),
        brownian_horizon=jnp.asarray(brownian_horizon, jnp.float32),
        replay_size=jnp.asarray(replay_size, jnp.int32),
        proposal_steps=jnp.asarray(proposal_steps, jnp.float32),
    )
