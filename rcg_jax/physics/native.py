"""engine=native: C MuJoCo's thread-pooled batch behind a call of the host. CPU only, nothing of physics to compile."""

from __future__ import annotations

import copy
import functools
import hashlib
import math
import threading
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.batch import Batch, SimulationError

from rcg_jax.physics.engine import with_act
from rcg_jax.physics.host_call import HostFunction, host_call
from rcg_jax.physics.silence import silence
from rcg_jax.types import PhysicsState


class NativeEngine:
    """``mujoco.batch`` as a pure function: at every step the whole state, in float32, goes in and comes out.

    So a trajectory depends on nothing but that state and can be resumed bit for bit. A program has the physics of the
    model as it is when the program is traced; to edit the model afterwards does not change it.

    Attributes:
        model: the model.
        variants: K models; simulation i of a batch has that of variant i modulo K. Without any, all have ``model``.
    """

    name = "native"
    fusion_emitters = True

    def __init__(self, model: mujoco.MjModel, variants: Sequence[mujoco.MjModel] = ()) -> None:
        """Physics of ``model``, or of each of its ``variants``."""
        self.model, *others = map(_awake, (model, *variants))
        self.variants = tuple(others)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`."""
        return jax.tree.map(lambda x: x[:, 0], self.steps(state, ctrl, 1))

    def steps(self, state: PhysicsState, ctrl: Array, num: int) -> PhysicsState:
        """``num`` steps under the same controls, leaves (B, num, ...): like calls of :meth:`step`, in one callback."""
        state = with_act(self.model, state)
        now = [state.qpos, state.qvel, state.qacc_warmstart, *([] if state.act is None else [state.act])]
        sizes = [(x.shape[0], num, *x.shape[1:]) for x in now]
        outputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in sizes]
        outputs.append(jax.ShapeDtypeStruct(sizes[0][:2], jnp.bool_))
        identity, physics = _physics(self.variants or (self.model,))
        qpos, qvel, warmstart, *act, bad = host_call(identity, physics, outputs, *now, ctrl)
        after = PhysicsState(qpos, qvel, warmstart, bad, *act)
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)  # in a program with float64 on, too


#: What programs of this process may call, by identity.
_PHYSICS: dict[int, HostFunction] = {}


def _physics(models: Sequence[mujoco.MjModel]) -> tuple[int, HostFunction]:
    """The physics of copies of these models, as a function on the host, and a number that only the same models have."""
    digest = hashlib.sha256()
    for model in models:
        saved = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, saved)
        digest.update(saved.tobytes())
    identity = int.from_bytes(digest.digest()[:8], "little") >> 1
    if identity not in _PHYSICS:
        _PHYSICS[identity] = _make_physics([copy.copy(model) for model in models])
    return identity, _PHYSICS[identity]


def _make_physics(models: Sequence[mujoco.MjModel]) -> HostFunction:
    """Steps simulations of ``models``. Leading axes (environments, and seeds under vmap) are flattened."""
    host = functools.lru_cache(_MAX_BATCHES)(functools.partial(_host, models))

    def steps(inputs: list[np.ndarray], out: list[np.ndarray]) -> None:
        first = inputs[0]
        nsim, batch = math.prod(first.shape[:-1]), first.shape[-2]
        width = batch if batch > 1 and len(models) > 1 else nsim  # environments one by one under vmap are a batch, too
        host(nsim, width)(
            [x.reshape(nsim, -1) for x in inputs], [x.reshape(nsim, -1, *x.shape[first.ndim :]) for x in out]
        )

    return steps


def _awake(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without sleep, which is state that depends on the past."""
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        model = copy.copy(model)
        model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return model


#: Batches, of so many sizes at most, that a model's physics keeps.
_MAX_BATCHES = 16

#: Time [s] before every step: no state here, so always the same. At 0 the PID plugin forgets its last control,
#: which is a part of its activation and of a start.
_LATER = 1.0

#: MuJoCo's warnings that it left out contacts or constraints, for which it had no room.
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


def _step_quietly(batch: Batch, left_out: np.ndarray) -> np.ndarray:
    """One step of all simulations; which of them MuJoCo could not simulate: a full buffer, any error of its own.

    Unstable ones are none of them: the guard sees those. ``left_out`` (nsim,): how often each was full so far; renewed.
    """
    failed = np.zeros(0, int)
    try:
        with silence():
            batch.step()
    except SimulationError as error:
        failed = np.asarray(error.ids)
    counts = batch.warning[:, _FULL, 1].sum(axis=1)
    if (counts == left_out).all():
        return failed
    full = np.flatnonzero(counts > left_out)
    left_out[:] = counts
    return np.union1d(failed, full)


def _host(models: Sequence[mujoco.MjModel], nsim: int, width: int) -> HostFunction:
    """A function that steps ``nsim`` simulations, batches of ``width``, under constant controls.

    From qpos, qvel, qacc_warmstart, act where the model has it, and ctrl, (nsim, n) each, into all but the last and
    ``bad`` after every step, (nsim, num, n) and (nsim, num).
    """
    model = models[0]
    batch = Batch(model, nsim)
    if len(models) > 1:
        batch.set_models([models[i % width % len(models)] for i in range(nsim)])
    names = ("qpos", "qvel", "qacc_warmstart", *(["act"] if model.na else []), "ctrl")
    *state, controls = (batch.bind(name) for name in names)
    if model.nplugin:
        clock = batch.bind("time")  # some plugins look whether it is 0
    left_out = np.zeros(nsim, int)
    lock = threading.Lock()  # XLA may run independent callbacks at the same time; a Batch serves one

    def step(inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        *now, ctrl = inputs
        *states, bad = outputs
        with lock, np.errstate(over="ignore", invalid="ignore"):  # beyond float32: inf, which counts as bad
            controls[:] = ctrl
            for i in range(bad.shape[1]):
                for field, value in zip(state, now, strict=True):
                    field[:] = value
                if model.nplugin:
                    clock[:] = _LATER
                broken = _step_quietly(batch, left_out)
                now, bad[:, i] = _guarded(now, [field.astype(np.float32) for field in state], broken)
                for out, value in zip(states, now, strict=True):
                    out[:, i] = value

    return step


def _guarded(old: list[np.ndarray], new: list[np.ndarray], broken: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """:func:`rcg_jax.physics.engine.guard` in NumPy; ``broken``: rows that MuJoCo could not simulate."""
    if not len(broken) and all(np.abs(x).max(initial=0.0) < mujoco.mjMAXVAL for x in new):  # False for NaN as well
        return new, np.zeros(len(new[0]), bool)
    fine = [(np.abs(x) < mujoco.mjMAXVAL).all(axis=1) for x in new]
    ok = np.logical_and.reduce([fine[0], fine[1], *fine[3:]])
    ok[broken] = False
    qpos, qvel, _, *act = (np.where(ok[:, None], x, before) for x, before in zip(new, old, strict=True))
    return [qpos, qvel, np.where((ok & fine[2])[:, None], new[2], np.float32(0.0)), *act], ~ok
