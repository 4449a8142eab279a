"""Scripted motions of the key: paths of key poses, the joint angles for them, and a controller that follows them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rcg_jax.physics import make_engine
from rcg_jax.physics.engine import reset
from rcg_jax.physics.jit import jit
from rcg_jax.tasks import Task

#: A key pose: height of the tip [m], and how far the key is turned clockwise from its pose at the goal [rad].
Pose = tuple[float, float]

QUARTER = np.pi / 2
OUTSIDE: Pose = (-0.45, 0.0)
INSERTED: Pose = (-0.62, 0.0)  # between the face's lower side and the bar
TURNED: Pose = (-0.62, QUARTER)
PUSHED: Pose = (-0.6895, QUARTER)
LOCKED: Pose = (-0.6905, 0.0)

#: Steps in which a path is followed, and for which its end is held.
STEPS, HOLD = 2500, 500
# [N m / rad], [N m s / rad].
_STIFFNESS, _DAMPING = 20.0, 2.0
_POINTS = 40  # of a path between two poses


def joint_path(task: Task, qpos: np.ndarray, poses: list[Pose]) -> np.ndarray:
    """Joint angles (K, nq) that move the upright key on the axis of the lock through ``poses``, from ``qpos`` on.

    Only the first is given: each further one is the nearest to the one before that puts the three reference points
    where they should be, by damped Gauss-Newton steps within the joints' ranges.
    """
    model, data = task.model, mujoco.MjData(task.model)
    sites = [model.site(name).id for name in ("tip", "top", "side")]
    low, high = model.jnt_range.T + np.array([[0.005], [-0.005]])
    path = [np.array(qpos)]
    for (z0, turn0), (z1, turn1) in itertools.pairwise(poses):
        for u in np.arange(1, _POINTS + 1) / _POINTS:
            z, turn = z0 + u * (z1 - z0), turn0 + u * (turn1 - turn0)
            side = [-0.15 * np.cos(turn), 0.304 + 0.15 * np.sin(turn), z + 0.15]
            wanted = np.array([[0, 0.304, z], [0, 0.304, z + 0.3], side])
            q = path[-1].copy()
            for _ in range(60):
                data.qpos[:] = q
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                jacobian = np.zeros((3, 3, model.nv))
                for k, site in enumerate(sites):
                    mujoco.mj_jacSite(model, data, jacobian[k], None, site)
                error = (wanted - data.site_xpos[sites]).ravel()
                j = jacobian.reshape(9, -1)
                free = ((q > low) | (j.T @ error > 0)) & ((q < high) | (j.T @ error < 0))  # joints not at their limits
                j = j * free
                q = np.clip(q + j.T @ np.linalg.solve(j @ j.T + 1e-5 * np.eye(9), error), low, high)
            assert np.linalg.norm(error) < 2e-3, (z, turn, error)
            path.append(q)
    return np.stack(path)


@dataclass(frozen=True)
class Motion:
    """One environment: a path to follow with bounded torques, or a force on the tool from the path's only point.

    Attributes:
        path: (K, nq).
        force: (3,) [N] on the tool frame; if not zero, the motors are off.
    """

    path: np.ndarray
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Outcome:
    """tip: (T, 3) positions of the key's tip; distance: (T,) to the goal [m]."""

    tip: np.ndarray
    distance: np.ndarray


def run_motions(task: Task, engine: str, motions: dict[str, Motion], contacts: bool = True) -> dict[str, Outcome]:
    """Does all motions side by side: PD control within the motors' 1 N m, or the force through joint torques."""
    # Wider motors, for the force alone.
    model = task.make_model()
    if not contacts:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.actuator_ctrlrange[:] = [-100, 100]
    physics = make_engine(engine, model)
    wanted, speed = (np.stack(x, 1) for x in zip(*(_timed(m.path, model.opt.timestep) for m in motions.values())))
    force = jnp.asarray([m.force for m in motions.values()], jnp.float32)
    pulled = jnp.any(force != 0, axis=1)[:, None]
    damping = jnp.asarray(model.dof_damping, jnp.float32)
    tip, top = (model.site(name).id for name in ("tip", "top"))

    def tool(qpos):
        points = task.snapshot(reset(qpos, jnp.zeros_like(qpos))).site_xpos
        return points[:, tip] + (points[:, top] - points[:, tip]) * (0.25 / 0.3)

    @jit
    def follow(qpos, wanted, speed):
        def step(state, now):
            q, v = now
            torque = damping * v + _STIFFNESS * (q - state.qpos) + _DAMPING * (v - state.qvel)
            push = jax.vjp(tool, state.qpos)[1](force)[0]
            state = physics.step(state, jnp.where(pulled, push, jnp.clip(torque, -1.0, 1.0)))
            s = task.snapshot(state)
            return state, (s.site_xpos[:, tip], jax.vmap(task.distance)(s))

        return jax.lax.scan(step, reset(qpos, jnp.zeros_like(qpos)), (wanted, speed))[1]

    tips, distance = jax.device_get(follow(*(jnp.asarray(x, jnp.float32) for x in (wanted[0], wanted, speed))))
    return {name: Outcome(tips[:, k], distance[:, k]) for k, name in enumerate(motions)}


def _timed(path: np.ndarray, timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (STEPS + HOLD, nq) along a path."""
    u = np.minimum(np.arange(STEPS + HOLD) / STEPS, 1) * (len(path) - 1)
    i = np.clip(u.astype(int), 0, max(len(path) - 2, 0))
    ahead = path[np.minimum(i + 1, len(path) - 1)] - path[i]
    position = path[i] + ahead * (u - i)[:, None]
    speed = ahead * (len(path) - 1) / STEPS / timestep
    speed[STEPS:] = 0
    return position, speed
