"""Raw physics throughput: how many environment steps per second the engines make with nothing around them.

    python -m experiments.raw_physics [--batch 256] [--steps 50] [--repeats 5]

All see the same start states and the same random controls, and take turns, so that their ratio means something on a
machine whose load changes. ``mjx`` is the step of engine=mjx under jit and scan; ``mjx_stock`` is ``mjx.step`` under
jit, vmap and scan with the same compiler options; ``native`` is ``mujoco.batch`` on all cores, without JAX.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.batch import Batch

from rcg_jax.base import PhysicsState
from rcg_jax.physics.compile import enable_compilation_cache, jit
from rcg_jax.physics.engine import reset
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.mjx_import import mjx

#: Runs all steps once and waits for the result.
Runner = Callable[[], None]


def random_controls(model: mujoco.MjModel, steps: int, batch: int, seed: int = 0) -> np.ndarray:
    """Uniform controls within the actuators' range, (steps, batch, nu) float32."""
    low, high = model.actuator_ctrlrange.T
    return np.random.default_rng(seed).uniform(low, high, (steps, batch, model.nu)).astype(np.float32)


def mjx_runner(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> Runner:
    """``engine=mjx`` from ``qpos`` (B, nq) at rest through ``ctrl`` (T, B, nu); compiled already."""
    return _scan(MjxEngine(model).step, qpos, ctrl, model.nv)


def stock_mjx_runner(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> Runner:
    """``mjx.step`` as it is, otherwise like :func:`mjx_runner`."""
    device_model = mjx.put_model(model)
    data = mjx.make_data(device_model)

    def one(state: PhysicsState, ctrl: Array) -> PhysicsState:
        d = data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl)
        d = mjx.step(device_model, d)
        return PhysicsState(qpos=d.qpos, qvel=d.qvel, qacc_warmstart=d.qacc_warmstart, bad=state.bad)

    return _scan(jax.vmap(one), qpos, ctrl, model.nv)


def native_runner(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray, nthread: int = 0) -> Runner:
    """``mujoco.batch`` on ``nthread`` threads (0: all cores), otherwise like :func:`mjx_runner`."""
    batch = Batch(model, len(qpos), nthread)

    def run() -> None:
        batch.qpos[:], batch.qvel[:], batch.qacc_warmstart[:] = qpos, 0.0, 0.0
        for u in ctrl:
            batch.ctrl[:] = u
            batch.step()

    run()
    return run


def throughput(runners: Mapping[str, Runner], env_steps: int, repeats: int = 5) -> dict[str, float]:
    """Median env-steps/s of each runner, ``env_steps`` each time. They take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in runners}
    for _ in range(repeats):
        for name, run in runners.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: env_steps / float(np.median(s)) for name, s in seconds.items()}


def compare(
    model: mujoco.MjModel, qpos: np.ndarray, *, steps: int = 50, seed: int = 0, repeats: int = 5, stock: bool = False
) -> dict[str, float]:
    """env-steps/s of ``mjx``, ``native`` and, where ``stock``, ``mjx_stock``, interleaved; their ratios are fair."""
    ctrl = random_controls(model, steps, len(qpos), seed)
    runners = {"native": native_runner(model, qpos, ctrl), "mjx": mjx_runner(model, qpos, ctrl)}
    if stock:
        runners["mjx_stock"] = stock_mjx_runner(model, qpos, ctrl)
    return throughput(runners, steps * len(qpos), repeats)


def _scan(step: Callable[[PhysicsState, Array], PhysicsState], qpos: np.ndarray, ctrl: np.ndarray, nv: int) -> Runner:
    def run(state: PhysicsState, ctrl: Array) -> PhysicsState:
        return jax.lax.scan(lambda s, u: (step(s, u), None), state, ctrl)[0]

    compiled = jit(run)
    start = reset(jnp.asarray(qpos, jnp.float32), jnp.zeros((len(qpos), nv)))
    controls = jnp.asarray(ctrl)

    def call() -> None:
        jax.block_until_ready(compiled(start, controls))

    call()
    return call


def main() -> None:
    """Measures ring_peg from its feasible starts and prints a table."""
    from rcg_jax import make_task

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256, help="environments")
    parser.add_argument("--steps", type=int, default=50, help="physics steps per repetition")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions; the median counts")
    args = parser.parse_args()
    enable_compilation_cache()
    task = make_task("ring_peg")
    starts = np.asarray(task.feasible_starts().qpos)
    qpos = starts[np.random.default_rng(0).integers(len(starts), size=args.batch)]
    speed = compare(task.model, qpos, steps=args.steps, repeats=args.repeats, stock=True)
    for name, value in speed.items():
        print(f"{name:10s} {value:10,.0f} env-steps/s   {value / speed['native']:5.2f} of native")


if __name__ == "__main__":
    main()
