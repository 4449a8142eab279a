"""engine=native: C MuJoCo's thread-pooled batch behind a host callback. CPU only, nothing of physics to compile."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.experimental.buffer_callback import buffer_callback
from mujoco.batch import Batch, SimulationError

from rcg_jax.physics.engine import guard
from rcg_jax.physics.silence import silence
from rcg_jax.types import PhysicsState


class NativeEngine:
    """``mujoco.batch`` as a pure function: at every step the whole state, in float32, goes in and comes out.

    So a trajectory depends on nothing but that state and can be resumed bit for bit.
    """

    name = "native"
    fusion_emitters = True

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._host = functools.cache(functools.partial(_host, model))

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`."""
        outputs = [jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in (state.qpos, state.qvel, state.qvel)]
        step = buffer_callback(self._step, outputs, has_side_effect=True, vmap_method="broadcast_all")
        return guard(state, *step(state.qpos, state.qvel, state.qacc_warmstart, ctrl))

    def _step(self, ctx: Any, out: Any, *args: Any) -> None:
        """Host side. Leading axes (environments, and seeds under vmap) are flattened; numpy only."""
        inputs, outputs = ([np.asarray(x) for x in arrays] for arrays in (args, out))
        self._host(int(np.prod(inputs[0].shape[:-1])))(inputs, outputs)


#: MuJoCo's warnings that it left out contacts or constraints, for which it had no room.
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


def _host(model: mujoco.MjModel, nsim: int) -> Callable[[list[np.ndarray], list[np.ndarray]], None]:
    """A function that steps ``nsim`` simulations from arrays into arrays of the same leading shape.

    What MuJoCo could not simulate (a full buffer, any error of its own) becomes NaN: the guard ends these episodes.
    """
    batch = Batch(model, nsim)
    fields = [batch.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")]
    times_full = np.zeros(nsim, int)
    lock = threading.Lock()  # XLA may run independent callbacks at the same time; a Batch serves one

    def step(inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        with lock:
            for field, value in zip(fields, inputs, strict=True):
                field[:] = value.reshape(field.shape)
            failed = np.zeros(0, int)
            try:
                with silence():
                    batch.step()
            except SimulationError as error:
                failed = np.asarray(error.ids)
            before = times_full.copy()
            times_full[:] = batch.warning[:, _FULL, 1].sum(axis=1)
            broken = times_full > before
            broken[failed] = True
            with np.errstate(over="ignore"):  # beyond float32: inf, which the guard reports
                for field, value in zip(fields[:3], outputs, strict=True):
                    value[...] = field.reshape(value.shape)
                    value.reshape(nsim, -1)[broken] = np.nan

    return step
