"""engine=mjx: MuJoCo XLA, everything under jit on CPU, GPU and TPU."""

from __future__ import annotations

import jax
import mujoco
from jax import Array
from mujoco import mjx

from rcg_jax.base import PhysicsState
from rcg_jax.physics.engine import guard


class MjxEngine:
    """Batched ``mjx.step``. Only positions, velocities and the solver's warm start travel between steps."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel) -> None:
        """Puts ``model`` on the default device.

        Raises:
            NotImplementedError: the model uses something that MJX lacks; MJX's message says what.
        """
        self.model = model
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(self._model)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`."""

        def one(qpos: Array, qvel: Array, warmstart: Array, ctrl: Array) -> tuple[Array, Array, Array]:
            data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            data = mjx.step(self._model, data)
            return data.qpos, data.qvel, data.qacc_warmstart

        return guard(state, *jax.vmap(one)(state.qpos, state.qvel, state.qacc_warmstart, ctrl))
