"""The point maze with short episodes, so that a training iteration of 100,000 environments takes minutes on a CPU."""

from __future__ import annotations

from rcg_jax.tasks.point_maze import PointMaze


class ShortMaze(PointMaze):
    """:class:`~rcg_jax.tasks.point_maze.PointMaze` with T = 50. Only good for measuring: most starts cannot succeed."""

    name = "short_maze"
    horizon = 50
