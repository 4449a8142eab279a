"""Confidence intervals and bins."""

from __future__ import annotations


def bin_width(furthest: float, finest: float, most: int = 30) -> float:
    """Width [m] of at most about ``most`` bins from 0 to ``furthest``: ``finest``, or 2, 5, 10, 20, ... times that."""
    scale = 1
    while True:
        for step in (1, 2, 5):
            if furthest <= most * finest * step * scale:
                return finest * step * scale
        scale *= 10


def wilson_interval(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success probability; ``z`` is the normal quantile, by default for 95 %."""
    rate = successes / episodes
    spread = 1 + z * z / episodes
    centre = (rate + z * z / (2 * episodes)) / spread
    half = z * ((rate * (1 - rate) + z * z / (4 * episodes)) / episodes) ** 0.5 / spread
    return max(0.0, centre - half), min(1.0, centre + half)
