"""engine=warp: MuJoCo Warp, NVIDIA's kernels for its GPUs, behind ``mjx.step`` under jit and vmap.

An optional extra, ``pip install rcg_jax[warp]``. It also runs on a CPU, slowly, which is how it is tested. On a GPU
contacts are collected in the order in which threads find them, so equal runs differ by rounding. Its arrays for
contacts and constraints have a fixed size; a simulation that would not fit in them is reported as bad.
"""

from __future__ import annotations

import copy
import importlib.util
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.config.settings import ConfigError
from rcg_jax.physics.engine import cannot_simulate, guard, with_act
from rcg_jax.physics.mjx_import import collision_driver, mjx
from rcg_jax.physics.unsupported import left_out_by_warp
from rcg_jax.types import PhysicsState

#: Most contacts and constraint rows of a simulation that memory is set aside for.
MOST_CONTACTS, MOST_ROWS = 256, 512


def check_warp() -> None:
    """Raises a ConfigError of one line where this engine's packages, or the GPU that it needs, are missing."""

    def refuse(why: str) -> NoReturn:
        raise ConfigError(f"engine=warp: {why} or choose engine=mjx") from None

    if importlib.util.find_spec("warp") is None:
        refuse("needs NVIDIA's warp-lang, which is not installed; pip install 'rcg_jax[warp]',")
    if jax.default_backend() == "cpu":
        return
    try:
        jax.devices("cuda")
    except RuntimeError:
        refuse(f"needs an NVIDIA GPU (or, slowly, a CPU); the JAX backend is {jax.default_backend()};")
    warp = _quiet_warp()
    if not warp.is_cuda_available():
        refuse(f"warp-lang {warp.__version__} cannot use this GPU's driver; install a newer driver,")


def _quiet_warp() -> Any:
    """NVIDIA's package, without a line on stdout for its devices and for each kernel."""
    import warp

    warp.config.log_level = warp.LOG_WARNING
    return warp


class WarpEngine:
    """Batched MuJoCo Warp. Only positions, velocities, activations and the solver's warm start travel between steps."""

    name = "warp"
    fusion_emitters = True

    def __init__(self, model: mujoco.MjModel) -> None:
        """Puts ``model`` on the first device of this process; an UnsupportedModelError says what Warp lacks."""
        check_warp()
        _quiet_warp()
        self.model = model
        if missing := left_out_by_warp(model):
            raise cannot_simulate("MuJoCo Warp", missing)
        self._contacts, self._rows = capacity(model)
        self._plain = copy.copy(model)
        # MuJoCo Warp never resets a simulation, and refuses the flag that says so.
        self._plain.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        try:
            warp_model = mjx.put_model(self._plain, device=jax.local_devices()[0], impl="warp")
            self._make_data(1)
        except NotImplementedError as error:
            raise cannot_simulate("MuJoCo Warp", str(error)) from error
        from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType as Flag

        self._too_small = int(Flag.NEFC | Flag.NJMAX_NNZ | Flag.BROADPHASE | Flag.NARROWPHASE | Flag.CCD)
        quiet = int(Flag.ITERATIONS | Flag.LS_ITERATIONS)
        # A solver that stops at its limit of iterations is no news, here as in C MuJoCo.
        self._model = warp_model.tree_replace({"opt._impl.warn_overflow": warp_model.opt._impl.warn_overflow & ~quiet})
        self._batched = jax.custom_batching.custom_vmap(self._step)
        self._batched.def_vmap(self._side_by_side)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`."""
        state = with_act(self.model, state)
        act = () if state.act is None else (state.act,)
        return guard(state, *self._batched(state.qpos, state.qvel, state.qacc_warmstart, ctrl, *act))

    def _step(self, qpos: Array, qvel: Array, warmstart: Array, ctrl: Array, *act: Array) -> tuple[Array, ...]:
        blank = self._make_data(len(qpos))

        def one(qpos: Array, qvel: Array, warmstart: Array, ctrl: Array, *act: Array) -> mjx.Data:
            data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            data = mjx.step(self._model, data.replace(act=act[0]) if act else data)
            return data._impl.overflow, data.qpos, data.qvel, data.qacc_warmstart, *(data.act for _ in act)

        overflow, qpos, *others = jax.vmap(one)(qpos, qvel, warmstart, ctrl, *act)
        lost = (overflow & self._too_small) != 0
        return jnp.where(lost.reshape(-1, 1), jnp.nan, qpos), *others

    def _side_by_side(self, axis_size: int, in_batched: list[bool], *args: Array) -> tuple[Any, Any]:
        """Under vmap, as over seeds, all simulations are one batch, and share its arrays."""
        full = [x if b else jnp.broadcast_to(x, (axis_size, *x.shape)) for x, b in zip(args, in_batched, strict=True)]
        out = self._batched(*(x.reshape(-1, *x.shape[2:]) for x in full))
        return tuple(x.reshape(axis_size, -1, *x.shape[1:]) for x in out), (True,) * len(out)

    def _make_data(self, number: int) -> mjx.Data:
        """What ``number`` simulations begin a step with."""
        with jax.ensure_compile_time_eval():
            room = {"naconmax": number * self._contacts, "njmax": self._rows}
            data = mjx.make_data(self._plain, device=jax.local_devices()[0], impl="warp", **room)
        return jax.tree.map(_short, data)


def _short(leaf: Any) -> Any:
    """An array of one value as an expression: the arrays for contacts are too large for a program's constants."""
    host = np.asarray(leaf)
    same = host.size > 1 and (host == host.flat[0]).all()
    return jnp.full(host.shape, host.flat[0], host.dtype) if same else leaf


def capacity(model: mujoco.MjModel) -> tuple[int, int]:
    """Contacts and constraint rows that one simulation of ``model`` can have at most, within the bounds above."""
    kind = mujoco.mjtGeom
    irregular = {kind.mjGEOM_HFIELD, kind.mjGEOM_MESH, kind.mjGEOM_SDF}
    pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    contacts = rows = 0
    for a, b, pair in collision_driver.geom_pairs(model):
        types = {kind(model.geom_type[a]), kind(model.geom_type[b])}
        most = 1 if kind.mjGEOM_SPHERE in types else 2 if kind.mjGEOM_CAPSULE in types else 8
        if types & irregular:
            most = mujoco.mjMAXCONPAIR
        dim = model.pair_dim[pair] if pair >= 0 else max(model.geom_condim[a], model.geom_condim[b])
        contacts += most
        rows += most * int(2 * (dim - 1) if pyramid and dim > 1 else dim)
    limits = np.count_nonzero(model.jnt_limited) + np.count_nonzero(model.tendon_limited)
    friction = np.count_nonzero(model.dof_frictionloss) + np.count_nonzero(model.tendon_frictionloss)
    rows += int(limits + friction) + 6 * model.neq
    return min(max(contacts, 1), MOST_CONTACTS), min(max(rows, 1), MOST_ROWS)
