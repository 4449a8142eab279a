"""Start states, controls and trajectories for the tests of the physics engines."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from rcg_jax.physics.engine import Engine, reset
from rcg_jax.physics.jit import jit
from rcg_jax.tasks import Task
from rcg_jax.types import PhysicsState

#: Environments in every MJX test: one batch size, one compilation.
BATCH = 256


def correlated_controls(steps: int, batch: int, nu: int, seed: int) -> np.ndarray:
    """Random walks in [-1, 1], (steps, batch, nu): they push, where white noise only shakes."""
    noise = np.random.default_rng(seed).standard_normal((steps, batch, nu)) * 0.5
    controls = np.zeros((steps + 1, batch, nu))
    for t in range(steps):
        controls[t + 1] = np.clip(controls[t] + noise[t], -1, 1)
    return controls[1:].astype(np.float32)


def around_the_peg(task: Task, batch: int = BATCH, seed: int = 0) -> np.ndarray:
    """States (batch, nq) of random pushes that begin in the goal state: the ring leans on peg and table."""
    sims = Batch(task.model, batch)
    sims.qpos[:] = task.goal_state
    lengths = np.random.default_rng(seed).integers(5, 150, batch)
    states = sims.qpos.copy()
    for t, ctrl in enumerate(correlated_controls(150, batch, task.model.nu, seed)):
        sims.ctrl[:] = ctrl
        sims.step()
        states[lengths == t] = sims.qpos[lengths == t]
    return states.astype(np.float32)


def on_the_way(task: Task, seed: int = 0) -> np.ndarray:
    """Ants (BATCH, nq) all over the maze, some steps into random motions: standing, falling, at walls."""
    rng = np.random.default_rng(seed)
    sims = Batch(task.model, BATCH)
    sims.qpos[:] = task.goal_state
    sims.qpos[:, :2] = np.asarray(task.way)[rng.integers(7, size=BATCH)] + rng.uniform(-0.5, 0.5, (BATCH, 2))
    lengths = rng.integers(5, 60, BATCH)
    states = sims.qpos.copy()
    for t, ctrl in enumerate(correlated_controls(60, BATCH, 8, seed)):
        sims.ctrl[:] = 150 * ctrl
        sims.step()
        states[lengths == t] = sims.qpos[lengths == t]
    return states.astype(np.float32)


def anywhere(task: Task, batch: int = BATCH, seed: int = 0) -> np.ndarray:
    """Joint angles (batch, nq) from a little beyond the joints' range; half of them touch, none deeper than 5 mm."""
    rng = np.random.default_rng(seed)
    low, high = task.model.jnt_range.T
    data = mujoco.MjData(task.model)
    states: list[np.ndarray] = []
    while len(states) < batch:
        data.qpos[:] = rng.uniform(low - 0.05, high + 0.05)
        mujoco.mj_kinematics(task.model, data)
        mujoco.mj_collision(task.model, data)
        wanted = data.ncon > 0 or len(states) % 2 == 0
        if wanted and all(c.dist > -0.005 for c in data.contact[: data.ncon]):
            states.append(data.qpos.astype(np.float32))
    return np.stack(states)


@functools.cache
def stepper(engine: Engine):
    """``engine.step``, compiled once per engine and batch size."""
    return jit(engine.step)


def trajectory(engine: Engine, qpos: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities after every step, (T, B, nq) and (T, B, nv)."""
    state: PhysicsState = reset(jnp.asarray(qpos), jnp.zeros((len(qpos), engine.model.nv)))
    states = []
    for ctrl in controls:
        state = stepper(engine)(state, jnp.asarray(ctrl))
        states.append(jax.device_get((state.qpos, state.qvel, state.bad)))
    assert not any(bad.any() for _, _, bad in states)
    return np.stack([q for q, _, _ in states]), np.stack([v for _, v, _ in states])


def contact_counts(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """C MuJoCo's number of contacts in each state, (...,) for (..., nq)."""
    sims = Batch(model, int(np.prod(qpos.shape[:-1])))
    count = sims.bind("ncon")
    sims.qpos[:] = qpos.reshape(-1, qpos.shape[-1])
    sims.forward(stage=mujoco.mjtStage.mjSTAGE_POS.value)
    return np.array(count, float).reshape(qpos.shape[:-1])
