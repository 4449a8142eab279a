"""Mazes from a cell map: open cells to sample from, walls merged into few boxes (every box is a candidate contact)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

#: Cells (first row, first column, row after, column after).
Rectangle = tuple[int, int, int, int]

#: Sides of a rectangle: the cell's neighbour there, (rows, columns). In the order of :data:`Rectangle`.
_SIDES = ((-1, 0), (0, -1), (1, 0), (0, 1))


@dataclass(frozen=True)
class Maze:
    """A grid of square cells.

    Attributes:
        rows: the map as seen from above, y upwards; ``#`` is wall, ``.`` open; the outermost cells are walls.
        origin: (x, y) of the centre of the lower left cell [m].
        size: edge length of a cell [m].
        height: height of the walls above the floor z = 0 [m].
        setback: how far a box stays behind a wall's face that another box forms [m].

    Raises:
        ValueError: the rows differ in length, hold other characters, no cell is open, or an outermost one is.
    """

    rows: tuple[str, ...]
    origin: tuple[float, float]
    size: float = 2.0
    height: float = 1.0
    setback: float = 0.12

    def __post_init__(self) -> None:
        if not self.rows or len({len(row) for row in self.rows}) != 1:
            raise ValueError(f"rows={self.rows}: must be of the same length")
        if set("".join(self.rows)) - set("#."):
            raise ValueError(f"rows={self.rows}: must consist of # (wall) and . (open)")
        if "." not in "".join(self.rows):
            raise ValueError(f"rows={self.rows}: must have an open cell")
        if "." in self.rows[0] + self.rows[-1] + "".join(row[0] + row[-1] for row in self.rows):
            raise ValueError(f"rows={self.rows}: must have walls all around")

    @cached_property
    def is_open(self) -> np.ndarray:
        """(rows, columns) bool; row 0 is the one of smallest y."""
        return np.array([[cell == "." for cell in row] for row in reversed(self.rows)])

    @property
    def open_centres(self) -> np.ndarray:
        """Centres (K, 2) of the open cells [m], by rows from the smallest y."""
        return self._centres(np.argwhere(self.is_open))

    def way_from(self, goal: ArrayLike) -> np.ndarray:
        """Centres (K, 2) [m] of the open cells that can be reached from a point (2,), its own first, by steps.

        Raises:
            ValueError: the point is in no open cell.
        """
        point = np.asarray(goal, float)
        start = tuple(np.floor((point - self.bounds[0]) / self.size).astype(int)[::-1].tolist())
        if start not in map(tuple, np.argwhere(self.is_open).tolist()):
            raise ValueError(f"goal={tuple(point.tolist())}: must be in an open cell")
        way = [start]
        for i, j in way:  # breadth first: it grows on the way; the walls all around keep it on the map
            beside = [(i + di, j + dj) for di, dj in _SIDES if self.is_open[i + di, j + dj]]
            way += [cell for cell in beside if cell not in way]
        return self._centres(np.array(way))

    @property
    def bounds(self) -> np.ndarray:
        """Lower left and upper right corner of the map, (2, 2) [m]."""
        return self._box((0, 0, *self.is_open.shape))

    def clearance(self, xy: Array) -> Array:
        """Distance () [m] of a point (2,) to the nearest wall; 0 within walls and outside of the map."""
        boxes = jnp.asarray(np.stack([self._box(r) for r in self.wall_rectangles()]), jnp.float32)
        beyond = jnp.maximum(jnp.maximum(boxes[:, 0] - xy, xy - boxes[:, 1]), 0.0)
        low, high = jnp.asarray(self.bounds, jnp.float32)
        inside = jnp.all((low < xy) & (xy < high))
        return jnp.where(inside, jnp.min(jnp.linalg.norm(beyond, axis=1)), 0.0)

    def sample(self, key: Array, num: int, clearance: float = 0.0) -> Array:
        """Points (num, 2) [m], uniform over where :meth:`clearance` is more than ``clearance`` [m], by rejection.

        Raises:
            ValueError: corridors of one cell are narrower than that.
        """
        if clearance >= self.size / 2:
            raise ValueError(f"clearance={clearance:g}: must be less than half a cell, {self.size / 2:g}")
        centres = jnp.asarray(self.open_centres, jnp.float32)

        def draw(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            key, points, clear = carry
            key, cell_key, place_key = jax.random.split(key, 3)
            cell = jax.random.randint(cell_key, (num,), 0, len(centres))
            fresh = centres[cell] + self.size * jax.random.uniform(place_key, (num, 2), minval=-0.5, maxval=0.5)
            points = jnp.where(clear[:, None], points, fresh)
            return key, points, jax.vmap(self.clearance)(points) > clearance

        start = key, jnp.zeros((num, 2)), jnp.zeros(num, bool)
        return jax.lax.while_loop(lambda c: ~jnp.all(c[2]), draw, start)[1]  # type: ignore[no-any-return]

    def wall_rectangles(self) -> list[Rectangle]:
        """Few rectangles of wall cells that cover all walls; they may overlap.

        Each straight face of a wall lies in one of them as a whole: a ball that slides along would feel an edge.
        """
        chosen: list[Rectangle] = []
        for face in sorted(self._faces(), key=_area, reverse=True):
            if not any(_contains(r, face) for r in chosen):
                chosen.append(next(r for r in self._candidates if _contains(r, face)))
        left = ~self.is_open
        for r in chosen:
            left[_cells(r)] = False
        while left.any():  # walls behind walls, out of reach
            chosen.append(max(self._candidates, key=lambda r: int(left[_cells(r)].sum())))
            left[_cells(chosen[-1])] = False
        return chosen

    def wall_boxes(self) -> list[np.ndarray]:
        """Lower left and upper right corner (2, 2) [m] of a box for each of :meth:`wall_rectangles`.

        A side that other rectangles form, too, is set back: no edge then lies flush on a face, where a ball would
        catch on it. An outer corner where two walls meet loses a notch as deep as :attr:`setback`.
        """
        rectangles = self.wall_rectangles()
        flush = {(r, side) for r in rectangles for side in range(4)}
        for r, side in sorted(flush, key=lambda x: (_area(_end(*x)), x)):
            covered = np.zeros(self.is_open.shape, bool)
            for o in rectangles:
                further = _bound(o, side) - _bound(r, side)
                if o != r and (further > 0 or (further == 0 and (o, side) in flush)):
                    covered[_cells(o)] = True
            if covered[_cells(_end(r, side))].all():
                flush.remove((r, side))
        back = [[0.0 if (r, side) in flush else self.setback for side in range(4)] for r in rectangles]
        return [self._box(r) + np.array([[b[1], b[0]], [-b[3], -b[2]]]) for r, b in zip(rectangles, back)]

    def add_walls(self, spec: mujoco.MjSpec) -> list[str]:
        """Adds :meth:`wall_boxes` to the world body, of the MJCF class ``wall``; returns their names: ``wall0``, ..."""
        for k, (low, high) in enumerate(self.wall_boxes()):
            spec.worldbody.add_geom(
                spec.find_default("wall"),
                name=f"wall{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*((low + high) / 2), self.height / 2],
                size=[*((high - low) / 2), self.height / 2],
            )
        return [f"wall{k}" for k in range(len(self.wall_boxes()))]

    @cached_property
    def _candidates(self) -> list[Rectangle]:
        """All rectangles of wall cells, the largest first."""
        rows, columns = self.is_open.shape
        spans = [range(1, length + 1) for length in (rows, columns)]
        return [
            (i, j, i + height, j + width)
            for height, width in sorted(product(*spans), key=lambda size: -size[0] * size[1])
            for i, j in product(range(rows - height + 1), range(columns - width + 1))
            if not self.is_open[i : i + height, j : j + width].any()
        ]

    def _faces(self) -> Iterator[Rectangle]:
        """The straight faces of walls: maximal runs of wall cells that have an open cell on the same side."""
        padded = np.pad(self.is_open, 1)
        rows, columns = self.is_open.shape
        for di, dj in _SIDES:
            face = ~self.is_open & padded[1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]
            lines = face if di else face.T
            for i, line in enumerate(lines):
                edges = np.flatnonzero(np.diff(np.pad(line.astype(int), 1)))
                for first, after in zip(edges[::2], edges[1::2]):
                    yield (i, int(first), i + 1, int(after)) if di else (int(first), i, int(after), i + 1)

    def _centres(self, cells: np.ndarray) -> np.ndarray:
        """Centres (K, 2) [m] of cells (K, 2), each (row, column)."""
        return np.array(self.origin) + self.size * cells[:, ::-1]

    def _box(self, r: Rectangle) -> np.ndarray:
        """Lower left and upper right corner (2, 2) [m] of a rectangle of cells."""
        top, left, bottom, right = r
        return np.array(self.origin) + self.size * (np.array([[left, top], [right, bottom]]) - 0.5)


def _cells(r: Rectangle) -> tuple[slice, slice]:
    """Index of a rectangle's cells."""
    return slice(r[0], r[2]), slice(r[1], r[3])


def _area(r: Rectangle) -> int:
    """Number of cells."""
    return (r[2] - r[0]) * (r[3] - r[1])


def _contains(outer: Rectangle, inner: Rectangle) -> bool:
    """Whether all cells of ``inner`` are in ``outer``."""
    return outer[0] <= inner[0] and outer[1] <= inner[1] and outer[2] >= inner[2] and outer[3] >= inner[3]


def _bound(r: Rectangle, side: int) -> int:
    """How far a rectangle reaches towards a side."""
    return r[side] if side >= 2 else -r[side]


def _end(r: Rectangle, side: int) -> Rectangle:
    """The row or column of a rectangle's cells at a side."""
    end = list(r)
    end[(side + 2) % 4] = r[side] + (1 if side < 2 else -1)
    return end[0], end[1], end[2], end[3]
