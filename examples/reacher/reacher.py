"""A planar arm of three links reaches into a corner between two walls."""

import jax.numpy as jnp
import numpy as np

from rcg_jax import Task


class Reacher(Task):
    """The arm's tip has to come within 3 cm of a point behind two walls; no reward until then."""

    xml = "reacher.xml"
    horizon = 250  # physics steps: 5 s

    goal_state = np.array([1.53, -0.89, -0.88])
    search = {"num_states": 4_000, "grid": 0.3}

    def _site(self, s, name):
        return s.site_xpos[self.model.site(name).id]

    def observe(self, s):
        return jnp.concatenate([s.qpos, s.qvel, self._site(s, "tip")[:2]])

    def distance(self, s):
        return jnp.linalg.norm(self._site(s, "tip") - self._site(s, "goal"))

    def is_goal(self, s):
        return self.distance(s) < 0.03

    def is_feasible(self, s):
        return jnp.bool_(True)
