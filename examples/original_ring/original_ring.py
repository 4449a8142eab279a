"""The ring as the authors' simulation of 2017 had it, rebuilt from its numbers: what preset=paper was made for.

    python -m rcg_jax.feasible task=examples/original_ring/original_ring.py:OriginalRing     # a minute
    python -m rcg_jax.run task=examples/original_ring/original_ring.py:OriginalRing engine=native preset=paper

What differs from ``ring_peg``, whose peg and arm follow the paper's text and what MJX collides cheaply:

- The peg is a cylinder with a flat top, 27.5 cm above the table (the text says 15 cm).
- The table is a box of 80 x 80 cm, so that the ring can also be beside and below it.
- Shoulder, upper arm, forearm, ring, table and peg all collide with each other. Links that meet in a joint overlap
  there all the time, and push each other.
- Links that carry nothing but mass, a longer shoulder, and MuJoCo's default number of line search steps.

Cylinders and boxes do not collide in MJX: ``engine=native`` only.
"""

import mujoco

from rcg_jax.tasks.ring_peg import RingPeg

TABLE_TOP, PEG_TOP = -0.425, -0.15
PEG_RADIUS = 0.028

#: Geoms that collide with each other: those of the arm, by body, and of the ring.
LINKS = ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "forearm_roll")
RING = ("ring_near", "ring_far", "ring_left", "ring_right")

#: Mass without contacts: body, ends of a capsule (the same point twice: a sphere), radius [m].
MASSES = (
    ("shoulder_pan", (-0.06, 0.05, 0.2), (-0.06, 0.05, 0.2), 0.05),
    ("shoulder_pan", (0.06, 0.05, 0.2), (0.06, 0.05, 0.2), 0.05),
    ("shoulder_pan", (-0.06, 0.09, 0.2), (-0.06, 0.09, 0.2), 0.03),
    ("shoulder_pan", (0.06, 0.09, 0.2), (0.06, 0.09, 0.2), 0.03),
    ("upper_arm_roll", (-0.1, 0, 0), (0.1, 0, 0), 0.02),
    ("forearm_roll", (-0.1, 0, 0), (0.1, 0, 0), 0.02),
    ("wrist_roll", (-0.02, 0, 0), (0.02, 0, 0), 0.01),
)


class OriginalRing(RingPeg):
    """Ring on peg with the authors' contacts, peg and masses; everything else as in ``ring_peg``."""

    training = {"policy.action_repeat": 1}
    #: Links that overlap where they meet are no reason to refuse a state.
    search = {"max_depth": 1.0, "num_states": 20_000}

    def __init__(self, engine="native"):
        super().__init__(engine)
        self._peg_top = PEG_TOP

    def make_spec(self):
        spec = super().make_spec()
        spec.option.iterations, spec.option.ls_iterations = 20, 50
        for pair in list(spec.pairs):
            spec.delete(pair)
        spec.geom("table").pos = (0, 0.3, TABLE_TOP - 0.025)
        spec.geom("table").type, spec.geom("table").size = mujoco.mjtGeom.mjGEOM_BOX, (0.4, 0.4, 0.025)
        peg, foot = spec.geom("peg"), TABLE_TOP - 0.025
        peg.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        peg.fromto = (0, 0.3, foot, 0, 0.3, PEG_TOP)
        peg.size = (PEG_RADIUS, 0, 0)
        spec.body("shoulder_pan").geoms[0].fromto = (0, 0, -0.4, 0, 0, 0.2)
        for body, a, b, radius in MASSES:
            sphere = a == b
            kind = mujoco.mjtGeom.mjGEOM_SPHERE if sphere else mujoco.mjtGeom.mjGEOM_CAPSULE
            geom = spec.body(body).add_geom(type=kind, size=(radius, 0, 0), density=1000, contype=0, conaffinity=0)
            if sphere:
                geom.pos = a
            else:
                geom.fromto = (*a, *b)
        solid = [spec.body(name).geoms[0] for name in LINKS] + [spec.geom(name) for name in (*RING, "table", "peg")]
        for geom in solid:
            geom.contype = geom.conaffinity = 1
        return spec
