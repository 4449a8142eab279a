"""Bins of distances, for tables and cards."""

from __future__ import annotations


def bin_width(furthest: float, finest: float, most: int = 30) -> float:
    """Width [m] of at most about ``most`` bins from 0 to ``furthest``: ``finest``, or 2, 5, 10, 20, ... times that."""
    scale = 1
    while True:
        for step in (1, 2, 5):
            if furthest <= most * finest * step * scale:
                return finest * step * scale
        scale *= 10
