"""What all mazes have in common: walls from a cell map, a goal in the plane, and where one may be."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.tasks.base import Task
from rcg_jax.tasks.maze import Maze
from rcg_jax.types import Snapshot


class MazeTask(Task):
    """Something has to get within ``goal_radius`` [m] of a point ``goal`` (x, y) [m] of a maze.

    The MJCF holds all but the maze: the agent, a default class ``wall``, a site ``goal``, a camera ``overview``, which
    is moved over the maze's centre. A custom maze is a subclass with its own ``maze`` and ``goal``; every open cell has
    to be connected with the goal's.
    """

    maze: Maze
    goal: tuple[float, float]
    goal_radius: float
    #: Which geoms collide with the walls, by name, with attributes of these contact pairs as in MJCF.
    wall_contacts: Mapping[str, Mapping[str, Any]] = MappingProxyType({})

    def make_spec(self) -> mujoco.MjSpec:
        """The MJCF with walls, their contact pairs, and goal.

        Raises:
            ValueError: the goal lies in a wall, or open cells cannot be reached from it.
        """
        reached = self.way.tolist()
        cut_off = [f"({x:g}, {y:g})" for x, y in self.maze.open_centres.tolist() if [x, y] not in reached]
        if cut_off:
            raise ValueError(f"goal={self.goal}: walls cut it off from the open cells at {', '.join(cut_off)}")
        spec = mujoco.MjSpec.from_file(str(self.xml))
        self.add_walls(spec)
        goal = spec.site("goal")
        goal.pos = [*self.goal, goal.pos[2]]
        # So high above the centre that the whole map is in the picture, seen under the camera's own angle.
        low, high = self.maze.bounds
        camera = spec.camera("overview")
        back = np.cross(camera.alt.xyaxes[:3], camera.alt.xyaxes[3:])
        camera.pos = [*((low + high) / 2), 0] + 1.3 * max(high - low) * back
        return spec

    def add_walls(self, spec: mujoco.MjSpec) -> None:
        """Adds the walls, and the contact pairs of :attr:`wall_contacts` with each of them."""
        for wall in self.maze.add_walls(spec):
            add_contacts(spec, wall, self.wall_contacts)

    @cached_property
    def way(self) -> np.ndarray:
        """Centres (K, 2) of the open cells [m], by steps from the goal's, which is the first."""
        return self.maze.way_from(self.goal)

    @abc.abstractmethod
    def position(self, s: Snapshot) -> Array:
        """Where in the maze it is, (2,) [m]."""

    def point(self, s: Snapshot) -> Array:
        """Its position, at the height of the centre of mass."""
        return jnp.append(self.position(s), s.com[2])

    def distance(self, s: Snapshot) -> Array:
        """As the crow flies, walls or not."""
        return jnp.linalg.norm(self.position(s) - jnp.asarray(self.goal))

    def is_goal(self, s: Snapshot) -> Array:
        return self.distance(s) < self.goal_radius


def add_contacts(spec: mujoco.MjSpec, wall: str, contacts: Mapping[str, Mapping[str, Any]]) -> None:
    """Contact pairs of a wall with geoms, given as in :attr:`MazeTask.wall_contacts`."""
    for geom, attributes in contacts.items():
        spec.add_pair(geomname1=geom, geomname2=wall, **attributes)
