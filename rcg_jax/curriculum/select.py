"""``select``: which starts are good, S^0_i = {s_0 : R_min <= R(pi_i, s_0) <= R_max} (section 4.1).

What follows from it, seeds and replay, is in :func:`rcg_jax.curriculum.growth.next_seeds`.
"""

from __future__ import annotations

from flax import struct
from jax import Array

from rcg_jax.types import StartLabels, StartSet


@struct.dataclass
class Difficulty:
    """Three disjoint masks (C,) over a start set; starts with too few episodes are in none of them.

    Attributes:
        low: R < R_min, too hard for now.
        good: R_min <= R <= R_max.
        high: R > R_max, mastered.
    """

    low: Array
    good: Array
    high: Array


@struct.dataclass
class Shares:
    """How the starts of an iteration are divided; all scalars.

    Attributes:
        share_low, share_good, share_high: shares of the labelled starts (too hard, good, mastered).
        labelled: share of the starts that were labelled.
    """

    share_low: Array
    share_good: Array
    share_high: Array
    labelled: Array


def difficulty(starts: StartSet, labels: StartLabels, *, r_min: float, r_max: float, min_episodes: int) -> Difficulty:
    """Sorts labelled starts by their success rate.

    Args:
        starts: rho_i, capacity C.
        labels: outcome of training on them.
        r_min, r_max: R_min, R_max.
        min_episodes: episodes that a label needs.
    """
    labelled = starts.valid & (labels.episodes >= min_episodes)
    rate = labels.success_rate
    low, high = rate < r_min, rate > r_max
    return Difficulty(low=labelled & low, good=labelled & ~low & ~high, high=labelled & high)
