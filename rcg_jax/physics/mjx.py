"""engine=mjx: MuJoCo XLA, everything under jit on CPU, GPU and TPU.

Smooth dynamics are MJX's. Where a model has no other constraints than joint limits and contacts, frictionless or with
sliding friction, this package finds and solves them (:mod:`rcg_jax.physics.contact_solver`): so the contacts are C
MuJoCo's, and a step on a CPU takes a quarter of the time. Any other model is stepped by ``mjx.step`` as it is.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
from jax import Array

from rcg_jax.physics.contact_solver import constraints, newton
from rcg_jax.physics.engine import cannot_simulate, guard, with_act
from rcg_jax.physics.mjx_import import collision_driver, mjx
from rcg_jax.physics.unsupported import approximate_contacts, geom_in_words, left_out, unconverged
from rcg_jax.types import PhysicsState


class MjxEngine:
    """Batched MJX. Only positions, velocities, activations and the solver's warm start travel between steps."""

    name = "mjx"
    fusion_emitters = False
    #: What it does otherwise than C MuJoCo, in words; empty if nothing that is known.
    differs: str
    #: Whether this package finds and solves contacts and limits itself; otherwise ``mjx.step`` does.
    solves_contacts: bool

    def __init__(self, model: mujoco.MjModel) -> None:
        """Puts ``model`` on the first device of this process; an UnsupportedModelError says what MJX lacks."""
        self.model = model
        self.solves_contacts = _own_constraints(model)
        if missing := left_out(model, own_limits=self.solves_contacts):
            raise cannot_simulate("MJX", missing)
        try:
            here = jax.local_devices()[0]  # the first of all may be another process's
            self._model = mjx.put_model(model, device=here)
            self._data = mjx.make_data(self._model, device=here)
        except NotImplementedError as error:
            raise cannot_simulate("MJX", _uncollidable(model) or str(error)) from error
        self.differs = "" if self.solves_contacts else _differences(model)
        if self.solves_contacts:
            self._rows = constraints.make_rows(model)

    def step(self, state: PhysicsState, ctrl: Array) -> PhysicsState:
        """See :class:`rcg_jax.physics.engine.Engine`."""
        step = self._own_step if self.solves_contacts else self._stock_step
        state = with_act(self.model, state)
        return guard(state, *step(state, ctrl))

    def _stock_step(self, state: PhysicsState, ctrl: Array) -> tuple[Array, ...]:
        def one(state: PhysicsState, ctrl: Array) -> tuple[Array, ...]:
            act = {} if state.act is None else {"act": state.act}
            data = self._data.replace(
                qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl, **act
            )
            data = mjx.step(self._model, data)
            return data.qpos, data.qvel, data.qacc_warmstart, *(data.act for _ in act)

        return jax.vmap(one)(state, ctrl)  # type: ignore[no-any-return]

    def _own_step(self, state: PhysicsState, ctrl: Array) -> tuple[Array, Array, Array]:
        opt = self.model.opt

        def smooth(qpos: Array, qvel: Array, ctrl: Array) -> tuple[mjx.Data, Array, Array]:
            data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
            data = mjx.com_pos(self._model, mjx.kinematics(self._model, data))
            data = mjx.transmission(self._model, mjx.crb(self._model, data))
            data = mjx.fwd_actuation(self._model, mjx.fwd_velocity(self._model, data))
            force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
            return data, mjx.full_m(self._model, data), force

        data, mass, force = jax.vmap(smooth)(state.qpos, state.qvel, ctrl)
        mass, force = jnp.moveaxis(mass, 0, -1), force.T
        qacc, qfrc = newton.solve(
            mass,
            self._rows(constraints.frames(state.qpos, state.qvel, data)),
            newton.solve_spd(mass, force),
            state.qacc_warmstart.T,
            iterations=opt.iterations,
            ls_iterations=opt.ls_iterations,
            tolerance=opt.tolerance,
        )
        # Euler, with the joints' damping taken at the end of the step.
        damping = jnp.asarray(self.model.dof_damping * opt.timestep, jnp.float32)
        implicit = mass + jnp.diag(damping)[:, :, None]
        qvel = state.qvel + opt.timestep * newton.solve_spd(implicit, force + qfrc).T
        return _move(self.model, state.qpos, opt.timestep * qvel), qvel, qacc.T


def _move(model: mujoco.MjModel, qpos: Array, step: Array) -> Array:
    """Positions (B, nq) after a displacement (B, nv) [m, rad]; a free joint turns about its own axes."""
    if not (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        return qpos + step
    parts = []
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind != mujoco.mjtJoint.mjJNT_FREE:
            parts.append(qpos[:, q, None] + step[:, v, None])
            continue
        parts.append(qpos[:, q : q + 3] + step[:, v : v + 3])
        parts.append(_turn(qpos[:, q + 3 : q + 7], step[:, v + 3 : v + 6]))
    return jnp.concatenate(parts, axis=1)


def _turn(quat: Array, angles: Array) -> Array:
    """Unit quaternions (B, 4) turned by rotation vectors (B, 3) [rad] in their own frame."""
    half = 0.5 * jnp.sqrt(jnp.maximum(jnp.sum(angles * angles, axis=1, keepdims=True), 1e-20))
    w1, v1 = quat[:, :1], quat[:, 1:]
    w2, v2 = jnp.cos(half), 0.5 * jnp.sin(half) / half * angles
    w = w1 * w2 - jnp.sum(v1 * v2, axis=1, keepdims=True)
    turned = jnp.concatenate([w, w1 * v2 + w2 * v1 + jnp.cross(v1, v2)], axis=1)
    return turned / jnp.linalg.norm(turned, axis=1, keepdims=True)


def _uncollidable(model: mujoco.MjModel) -> str:
    """The first pair of geoms that may meet and that MJX cannot collide, in words; empty if there is none."""
    for a, b, _ in collision_driver.geom_pairs(model):
        if not collision_driver.has_collision_fn(model.geom_type[a], model.geom_type[b]):
            pair = (f"{geom_in_words(model, g)} of body {model.body(model.geom_bodyid[g]).name}" for g in (a, b))
            return f"no contacts between {' and '.join(pair)}"
    return ""


def _differences(model: mujoco.MjModel) -> str:
    """What ``mjx.step`` does otherwise than C MuJoCo, in words; contacts that are others altogether are refused."""
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    meeting = collision_driver.geom_pairs(model) if model.ngeom > 1 and not model.opt.disableflags & off else ()
    wrong, others = approximate_contacts(model, [(int(a), int(b)) for a, b, _ in meeting])
    if wrong:
        raise cannot_simulate("MJX", f"no contacts as C MuJoCo's between {wrong}")
    differences = []
    if others:
        differences.append(f"finds the contacts of {others} at other points")
    if few := unconverged(model):
        differences.append(f"stops after few solver iterations ({few}) at other forces")
    return "; ".join(f"engine=mjx {what} than C MuJoCo (engine=native)" for what in differences)


def _own_constraints(model: mujoco.MjModel) -> bool:
    """Whether this package steps ``model`` itself."""
    euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    newton_solver = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    return bool(euler and damped and newton_solver and model.na == 0 and constraints.supported(model))
