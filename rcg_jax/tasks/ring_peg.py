"""Ring on peg (paper, section 5 and figure 1c)."""

from __future__ import annotations

from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jax import Array

from rcg_jax.io.assets import XML
from rcg_jax.tasks.base import Task
from rcg_jax.types import Snapshot


class RingPeg(Task):
    """A 7-DOF arm puts a square disk with a square hole on a round peg, 5 mm of clearance.

    Goal set: the disk's centre within 3 cm of the point 25 mm above the table on the peg's axis. S^0: all
    collision-free arm configurations, at rest, whose disk centre is within 40 cm of that point. The one goal point is
    constant, so the observation leaves it out. Deviation from the original simulation: the peg is a capsule and the
    table a plane, which MJX collides cheaply; of the arm itself upper arm and forearm meet table and peg.
    """

    name = "ring_peg"
    xml = XML / "ring_peg.xml"
    observation = (
        ("joint angles", 7, "rad", "data.qpos"),
        ("joint velocities", 7, "rad/s", "data.qvel"),
        ("disk centre", 3, "m", "data.site('disk').xpos"),
    )
    point_name = "the centre of the disk"
    part_names = MappingProxyType({**Task.part_names, "on_peg": "on the peg"})
    goal_radius = 0.03
    feasible_radius = 0.4

    def __init__(self, engine: str = "mjx") -> None:
        super().__init__(engine)
        self._disk = self.model.site("disk").id
        self._goal = jnp.asarray(self.model.site("goal").pos, jnp.float32)
        self._hole, _, self._half_thickness = map(float, self.model.geom("ring_left").size)
        peg = self.model.geom("peg")
        self._peg_top = float(peg.pos[2] + peg.size[0] + peg.size[1])

    @property
    def goal_state(self) -> np.ndarray:
        return np.array([0.387, 1.137, -2.028, -1.744, 2.029, -0.873, 1.55])

    def observe(self, s: Snapshot) -> Array:
        """Joint angles (7), joint velocities (7), disk centre (3)."""
        return jnp.concatenate([s.qpos, s.qvel, s.site_xpos[self._disk]])

    def distance(self, s: Snapshot) -> Array:
        return jnp.linalg.norm(s.site_xpos[self._disk] - self._goal)

    def is_goal(self, s: Snapshot) -> Array:
        return self.distance(s) < self.goal_radius

    def is_feasible(self, s: Snapshot) -> Array:
        return self.distance(s) < self.feasible_radius

    def composition(self, s: Snapshot) -> dict[str, Array]:
        """``at_goal``, and ``on_peg``: the peg's tip is in the hole or through it.

        That is: the peg's axis passes through the hole, less than 26 degrees from perpendicular to the disk, and the
        disk's mid-plane meets it no more than half a thickness above the tip.
        """
        centre, frame = s.site_xpos[self._disk], s.xmat[self.model.site_bodyid[self._disk]]
        normal = frame[:, 2]
        upright = jnp.abs(normal[2]) > 0.9
        # Where the vertical axis meets the mid-plane: the point (x, y, z) with (point - centre) . normal = 0.
        offset = self._goal[:2] - centre[:2]
        rise = -jnp.dot(normal[:2], offset) / jnp.where(upright, normal[2], 1.0)
        inside = jnp.abs(frame[:, :2].T @ jnp.append(offset, rise)) < self._hole
        low = centre[2] + rise < self._peg_top + self._half_thickness
        return {**super().composition(s), "on_peg": upright & jnp.all(inside) & low}
