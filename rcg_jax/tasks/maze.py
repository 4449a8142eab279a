"""Mazes from a cell map: open cells to sample from, walls merged into few boxes (every box is a candidate contact)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np


@dataclass(frozen=True)
class Maze:
    """A grid of square cells.

    Attributes:
        rows: the map as seen from above, y upwards: the first string is the row of largest y.
            ``#`` is wall, ``.`` open.
        origin: (x, y) of the centre of the lower left cell [m].
        size: edge length of a cell [m].
        height: height of the walls above the floor z = 0 [m].

    Raises:
        ValueError: the rows differ in length, hold other characters, or no cell is open.
    """

    rows: tuple[str, ...]
    origin: tuple[float, float]
    size: float = 2.0
    height: float = 1.0

    def __post_init__(self) -> None:
        if not self.rows or len({len(row) for row in self.rows}) != 1:
            raise ValueError(f"rows={self.rows}: must be of the same length")
        if set("".join(self.rows)) - set("#."):
            raise ValueError(f"rows={self.rows}: must consist of # (wall) and . (open)")
        if "." not in "".join(self.rows):
            raise ValueError(f"rows={self.rows}: must have an open cell")

    @property
    def is_open(self) -> np.ndarray:
        """(rows, columns) bool; row 0 is the one of smallest y."""
        return np.array([[cell == "." for cell in row] for row in reversed(self.rows)])

    @property
    def open_centres(self) -> np.ndarray:
        """Centres (K, 2) of the open cells [m], by rows from the smallest y."""
        i, j = np.nonzero(self.is_open)
        return np.stack([self.origin[0] + self.size * j, self.origin[1] + self.size * i], axis=1)

    def wall_rectangles(self) -> list[tuple[int, int, int, int]]:
        """Few rectangles of wall cells (first row, first column, row after, column after) that cover all walls.

        Greedy: the one that covers most of what is left. They may overlap, which costs nothing.
        """
        wall = ~self.is_open
        left, chosen = wall.copy(), []
        candidates = list(_rectangles(wall))
        while left.any():
            best = max(candidates, key=lambda r: int(left[r[0] : r[2], r[1] : r[3]].sum()))
            left[best[0] : best[2], best[1] : best[3]] = False
            chosen.append(best)
        return chosen

    def add_walls(self, spec: mujoco.MjSpec, default: str = "wall") -> None:
        """Adds the walls to the world body as boxes ``wall0``, ``wall1``, ... of the MJCF class ``default``."""
        for k, (top, left, bottom, right) in enumerate(self.wall_rectangles()):
            half = np.array([right - left, bottom - top]) * self.size / 2
            corner = np.array(self.origin) - self.size / 2 + np.array([left, top]) * self.size
            spec.worldbody.add_geom(
                spec.find_default(default),
                name=f"wall{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*(corner + half), self.height / 2],
                size=[*half, self.height / 2],
            )


def _rectangles(wall: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """All rectangles of wall cells, the largest first."""
    rows, columns = wall.shape
    sizes = sorted(product(range(1, rows + 1), range(1, columns + 1)), key=lambda s: -s[0] * s[1])
    for height, width in sizes:
        for i, j in product(range(rows - height + 1), range(columns - width + 1)):
            if wall[i : i + height, j : j + width].all():
                yield i, j, i + height, j + width
