"""The protocol that every physics engine implements: batched, pure, one small state pytree."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
import mujoco
from jax import Array

from rcg_jax.types import PhysicsState


class UnsupportedModelError(NotImplementedError):
    """An engine cannot simulate a model; one line that says what it lacks."""


class Engine(Protocol):
    """Steps B copies of one MuJoCo model. Pure: usable under jit, scan and vmap.

    An engine that makes several steps under the same controls faster than one by one has a method
    ``steps(state, ctrl, num)`` as well, see :meth:`rcg_jax.physics.native.NativeEngine.steps`.
    """

    name: str
    model: mujoco.MjModel
    #: How programs with this physics are compiled on a CPU (:func:`rcg_jax.physics.jit.jit`).
    fusion_emitters: bool

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """One physics step of ``model.opt.timestep`` seconds.

        Args:
            state: B states.
            ctrl: (B, nu) controls, already within the actuators' range.

        Returns:
            The next state. Rows whose physics turned non-finite keep the old state and have ``bad`` set.
        """
        ...


def reset(qpos: Array, qvel: Array) -> PhysicsState:
    """B simulations at the given state (B, nq), (B, nv), with a cold solver."""
    return PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel), bad=jnp.zeros(qpos.shape[0], bool))


def guard(old: PhysicsState, qpos: Array, qvel: Array, qacc_warmstart: Array) -> PhysicsState:
    """The state after a step, where non-finite rows fall back to ``old`` and are marked bad.

    The bound is MuJoCo's own mjMAXVAL: beyond it C MuJoCo, too, calls a simulation unstable.
    """

    def fine(x: Array) -> Array:
        return jnp.all(jnp.abs(x) < mujoco.mjMAXVAL, axis=-1)  # False for NaN as well

    ok = fine(qpos) & fine(qvel)
    keep = ok[:, None]
    after = PhysicsState(
        qpos=jnp.where(keep, qpos, old.qpos),
        qvel=jnp.where(keep, qvel, old.qvel),
        qacc_warmstart=jnp.where(keep & fine(qacc_warmstart)[:, None], qacc_warmstart, 0.0),
        bad=~ok,
    )
    return jax.tree.map(lambda new, old: new.astype(old.dtype), after, old)  # in a program with float64 on, too
