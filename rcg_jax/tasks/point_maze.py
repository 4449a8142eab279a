"""Point-mass maze (paper, section 5 and figure 1a)."""

from __future__ import annotations

from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jax import Array

from rcg_jax.io.assets import XML
from rcg_jax.tasks.maze import Maze
from rcg_jax.tasks.maze_task import MazeTask
from rcg_jax.types import Snapshot, StartSet


class PointMaze(MazeTask):
    """A ball, pushed in x and y, rolls through a G-shaped maze of cells of 2 m to its end at (4, 4).

    Goal set: the ball's centre within 0.3 m of the goal. S^0: all positions, at rest, where the ball overlaps no wall.
    The goal is constant, so the observation leaves it out.

    Nothing slows the ball down but walls, which take away its speed towards them, without friction and without bounce.
    It reaches nearly 10 m/s, or 0.2 m in a step of physics. Therefore walls stop it up to 0.1 m before it would touch
    them, so that even at full speed its centre stays out of them; from there it is free to slide along or to leave.
    """

    name = "point_maze"
    xml = XML / "point_maze.xml"
    observation = (("position", 2, "m", "data.qpos"), ("velocity", 2, "m/s", "data.qvel"))
    point_name = "the centre of the ball"
    search = MappingProxyType({"num_states": 10_000})
    maze = Maze(
        rows=(
            "#######",
            "#.....#",
            "#.#####",
            "#.#...#",
            "#.###.#",
            "#.....#",
            "#######",
        ),
        origin=(-6.0, -6.0),
    )
    goal = (4.0, 4.0)
    goal_radius = 0.3
    # A time constant of two steps takes all speed within a single one. The bumper is so overdamped that it pushes
    # nothing back: what rests beside a wall stays there. The ball does, gently, where a fast one got into a wall.
    wall_contacts = MappingProxyType(
        {
            "bumper": {"condim": 1, "solref": (0.04, 300.0), "solimp": (0.999, 0.999, 0.001, 0.5, 2.0)},
            "ball": {"condim": 1, "solref": (0.04, 2.0), "solimp": (0.99, 0.99, 0.001, 0.5, 2.0)},
        }
    )

    def __init__(self, engine: str = "mjx") -> None:
        super().__init__(engine)
        self._radius = float(self.model.geom("ball").size[0])

    @property
    def goal_state(self) -> np.ndarray:
        return np.array(self.goal)

    def position(self, s: Snapshot) -> Array:
        return s.qpos

    def observe(self, s: Snapshot) -> Array:
        """x, y, and their velocities."""
        return jnp.concatenate([s.qpos, s.qvel])

    def is_feasible(self, s: Snapshot) -> Array:
        return self.maze.clearance(s.qpos) > self._radius

    def sample_feasible(self, key: Array, num: int) -> StartSet:
        return StartSet.at_rest(self.maze.sample(key, num, self._radius), self.model.nv)
