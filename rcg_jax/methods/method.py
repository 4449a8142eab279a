"""What a method is: where the starts of each training iteration come from."""

from __future__ import annotations

from typing import Any, Protocol

from flax import struct
from jax import Array

from rcg_jax.base import StartLabels, StartSet


@struct.dataclass
class MethodMetrics:
    """What a method reports about one iteration; all scalars.

    Attributes:
        share_low, share_good, share_high: shares of the labelled starts (too hard, good, mastered).
        labelled: share of the starts that were labelled.
        brownian_horizon: T_B of this iteration [physics steps]; 0 without walks.
        replay_size: starts in the replay.
        walk_steps: physics steps spent on finding starts.
    """

    share_low: Array
    share_good: Array
    share_high: Array
    labelled: Array
    brownian_horizon: Array
    replay_size: Array
    walk_steps: Array


class Method(Protocol):
    """A way to choose rho_i. Its state is a pytree of its own, opaque to everything else."""

    def init(self, key: Array) -> Any:
        """State before the first iteration."""
        ...

    def propose(self, key: Array, state: Any) -> StartSet:
        """rho_i: the starts to train on, of constant capacity, at least one valid."""
        ...

    def update(self, key: Array, state: Any, starts: StartSet, labels: StartLabels) -> tuple[Any, MethodMetrics]:
        """State after training on ``starts`` showed ``labels``."""
        ...
