"""The protocol that every physics engine implements: batched, pure, one small state pytree."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
import mujoco
from jax import Array

from rcg_jax.types import PhysicsState


class UnsupportedModelError(NotImplementedError):
    """An engine cannot simulate a model; one line that says what it lacks."""


def cannot_simulate(simulator: str, what: str) -> UnsupportedModelError:
    """The refusal of a model by MJX or MuJoCo Warp, where C MuJoCo can simulate it."""
    words = " ".join(what.split())
    return UnsupportedModelError(f"{simulator} cannot simulate this model: {words} (engine=native can)")


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
        """The states after ``model.opt.timestep`` seconds under controls (B, nu) within the actuators' range.

        Rows whose physics turned non-finite keep the old state and have ``bad`` set.
        """
        ...


def reset(qpos: Array, qvel: Array, act: Array | None = None) -> PhysicsState:
    """B simulations at the given state (B, nq), (B, nv) and, with activations, (B, na); with a cold solver."""
    bad = jnp.zeros(qpos.shape[0], bool)
    return PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel), bad=bad, act=act)


def with_act(model: mujoco.MjModel, state: PhysicsState) -> PhysicsState:
    """``state``, with activations of 0, as MuJoCo resets them, where it lacks the ones that the model has."""
    if state.act is not None or not model.na:
        return state
    return dataclasses.replace(state, act=jnp.zeros((state.qpos.shape[0], model.na), state.qpos.dtype))


def guard(old: PhysicsState, qpos: Array, qvel: Array, qacc_warmstart: Array, act: Array | None = None) -> PhysicsState:
    """The state after a step, where non-finite rows fall back to ``old`` and are marked bad.

    The bound is MuJoCo's own mjMAXVAL: beyond it C MuJoCo, too, calls a simulation unstable.
    """

    def fine(x: Array) -> Array:
        return jnp.all(jnp.abs(x) < mujoco.mjMAXVAL, axis=-1)  # False for NaN as well

    ok = fine(qpos) & fine(qvel)
    if act is not None:
        ok &= fine(act)
    keep = ok[:, None]
    after = PhysicsState(
        qpos=jnp.where(keep, qpos, old.qpos),
        qvel=jnp.where(keep, qvel, old.qvel),
        qacc_warmstart=jnp.where(keep & fine(qacc_warmstart)[:, None], qacc_warmstart, 0.0),
        bad=~ok,
        act=None if act is None or old.act is None else jnp.where(keep, act, old.act),
    )
    return jax.tree.map(lambda new, old: new.astype(old.dtype), after, old)  # in a program with float64 on, too
