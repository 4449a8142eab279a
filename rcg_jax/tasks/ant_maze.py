"""Ant maze (paper, section 5 and figure 1b)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.io.assets import XML
from rcg_jax.tasks.base import AnyArray
from rcg_jax.tasks.maze import Maze
from rcg_jax.tasks.maze_task import MazeTask, add_contacts
from rcg_jax.types import Snapshot

_FEET = tuple(f"foot_{k}" for k in range(1, 5))
_LIMBS = tuple(f"{part}_{k}" for part in ("leg", "ankle") for k in range(1, 5))
_FRICTIONLESS = MappingProxyType({"condim": 1, "margin": 0.01})


class AntMaze(MazeTask):
    """A quadruped walks to the end of a U-shaped maze of seven cells of 2 m.

    Goal set: the centre of mass within 0.5 m of (0, 4) in the plane. An episode also ends, as a failure, where the
    torso's height leaves [0.3, 1.0] m. S^0: ants at rest inside the maze that stay upright when nothing moves them.
    The goal point is constant, so the observation leaves it out.

    Deviations from the original simulation: Euler instead of RK4; of the ant only the feet touch the floor (with
    another part there, it has fallen or is about to); walls are frictionless, and the outer ones, which are never met
    from behind, are planes. Outer walls stop torso and feet, not the knees between them: in 500 runs of integrated
    noise from the goal state, until the ant falls, a knee reaches beyond an outer wall in 8 %, by at most 24 cm, and
    feet sink into outer walls, soft as a step of 20 ms makes them, by more than 5 cm in 15 %, by at most 11 cm.
    """

    name = "ant_maze"
    xml = XML / "ant_maze.xml"
    point_name = "the ant's centre of mass"
    observation = (
        ("torso position, its quaternion, joint angles", 15, "m, -, rad", "data.qpos"),
        ("their velocities", 14, "m/s, rad/s", "data.qvel"),
        ("torso rotation matrix by rows", 9, "-", "data.body('torso').xmat"),
        ("centre of mass", 3, "m", "data.subtree_com[0]"),
    )
    horizon = 2000
    settle_steps = 100  # walks pass through states in the middle of a tumble, which S^0 does not have
    search = MappingProxyType(
        {
            "seeds": "starts",
            "walk_length": 100,
            "num_states": 2000,
            "max_rounds": 160,
            "grid": 0.15,
            "max_depth": 0.01,
            "max_excess": 0.05,
            "max_drift": 0.15,
        }
    )
    maze = Maze(
        rows=(
            "#####",
            "#...#",
            "###.#",
            "#...#",
            "#####",
        ),
        origin=(-2.0, -2.0),
    )
    goal = (0.0, 4.0)
    goal_radius = 0.5
    heights = (0.3, 1.0)
    #: With the walls that reach into the maze, and with the planes of the outer walls.
    wall_contacts = MappingProxyType(dict.fromkeys(("torso", *_LIMBS), _FRICTIONLESS))
    border_contacts = MappingProxyType(dict.fromkeys(("torso", *_FEET), _FRICTIONLESS))

    def add_walls(self, spec: mujoco.MjSpec) -> None:
        """Outer walls collide as planes, and only walls that reach into the maze as boxes."""
        walls = self.maze.add_walls(spec)
        corners = self.maze.open_centres
        low, high = corners.min(0) - self.maze.size / 2, corners.max(0) + self.maze.size / 2
        for axis in range(2):
            for side, bound in ((1, low), (-1, high)):
                name = f"border_{'-+'[side < 0]}{'xy'[axis]}"
                centre = [*np.where(np.arange(2) == axis, bound, (low + high) / 2), 0]
                quat = np.zeros(4)
                mujoco.mju_quatZ2Vec(quat, side * np.eye(3)[axis])  # turns the z axis onto the normal
                spec.worldbody.add_geom(spec.find_default("border"), name=name, pos=centre, quat=quat)
                add_contacts(spec, name, self.border_contacts)
        for wall, (start, end) in zip(walls, self.maze.wall_boxes(), strict=True):
            if np.all(start < high) and np.all(end > low):  # reaches into the maze
                add_contacts(spec, wall, self.wall_contacts)

    @property
    def goal_state(self) -> np.ndarray:
        """Upright over the goal, at rest on its feet."""
        return np.array([*self.goal, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1.0])

    def observe(self, s: Snapshot) -> Array:
        """Positions (15), velocities (14), torso rotation matrix by rows (9), centre of mass (3)."""
        return jnp.concatenate([s.qpos, s.qvel, s.xmat[self.model.body("torso").id].reshape(-1), s.com])

    def position(self, s: Snapshot) -> Array:
        """Centre of mass."""
        return s.com[:2]

    def is_feasible(self, s: Snapshot) -> Array:
        return ~self.is_failure(s)

    def is_failure(self, s: Snapshot) -> Array:
        height, (low, high) = s.qpos[2], self.heights
        return (height < low) | (height > high)

    def composition(self, s: Snapshot) -> dict[str, Array]:
        """``at_goal``, and ``cell_0``, ``cell_1``, ...: the cells by steps from the goal, 0 the goal's own."""
        cell = jnp.argmin(jnp.linalg.norm(jnp.asarray(self.way) - s.qpos[:2], axis=1))
        return {**super().composition(s), **{f"cell_{k}": cell == k for k in range(len(self.way))}}

    @cached_property
    def part_names(self) -> Mapping[str, str]:  # type: ignore[override]
        """The cells by their centres."""
        cells = {f"cell_{k}": f"cell around ({x:g}, {y:g}) m" for k, (x, y) in enumerate(self.way.tolist())}
        return {**super().part_names, **cells}

    def grid_coordinates(self, qpos: AnyArray) -> AnyArray:
        """Where the torso is, (C, 2) [m]."""
        return qpos[:, :2]
