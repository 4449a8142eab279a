"""Forward kinematics of a batch of states, shared by all engines.

After ``mjx.step`` and after ``Batch.step`` derived quantities belong to the state before integration, so tasks get
theirs from here, at the state itself.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx

from rcg_jax.base import Snapshot


def make_kinematics(model: mujoco.MjModel) -> Callable[[Array, Array], Snapshot]:
    """Returns a function (qpos (B, nq), qvel (B, nv)) -> Snapshot with leading axis B."""
    # Kinematics need no geometry; without geoms every model can be put on a device, whatever it collides with.
    spec_model = mjx.put_model(model)
    data = mjx.make_data(spec_model)
    moving = np.flatnonzero(model.body_weldid != 0)
    mass = jnp.asarray(model.body_mass[moving] / model.body_mass[moving].sum(), jnp.float32)

    def one(qpos: Array, qvel: Array) -> Snapshot:
        d = mjx.kinematics(spec_model, data.replace(qpos=qpos, qvel=qvel))
        return Snapshot(
            qpos=qpos,
            qvel=qvel,
            xpos=d.xpos,
            xmat=d.xmat,
            site_xpos=d.site_xpos,
            com=mass @ d.xipos[moving],
        )

    return jax.vmap(one)
