"""Raw physics throughput: how many environment steps per second the engines make with nothing around them.

    python -m experiments.benchmarks.raw_physics                                # ring_peg; --help lists the settings
    python -m experiments.benchmarks.raw_physics task=point_maze batch=1024

All see the same start states and the same random controls, and take turns, so that their ratio means something on a
machine whose load changes. ``mjx`` is the step of engine=mjx under jit and scan; ``mjx_stock`` is ``mjx.step`` under
jit, vmap and scan with the same compiler options; ``native`` is ``mujoco.batch`` on all cores, without JAX.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.batch import Batch

from experiments.common import options
from rcg_jax.config.settings import option
from rcg_jax.physics.engine import reset
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.mjx_import import mjx
from rcg_jax.physics.warp import WarpEngine
from rcg_jax.tasks import Task, make_task
from rcg_jax.types import PhysicsState

#: Runs all steps once and waits for the result.
Runner = Callable[[], None]


def random_controls(model: mujoco.MjModel, steps: int, batch: int, seed: int = 0) -> np.ndarray:
    """Uniform controls within the actuators' range, (steps, batch, nu) float32."""
    low, high = model.actuator_ctrlrange.T
    return np.random.default_rng(seed).uniform(low, high, (steps, batch, model.nu)).astype(np.float32)


def mjx_runner(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> Runner:
    """``engine=mjx`` from ``qpos`` (B, nq) at rest through ``ctrl`` (T, B, nu); compiled already."""
    return _scan(MjxEngine(model).step, qpos, ctrl, model.nv)


def warp_runner(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> Runner:
    """``engine=warp``, otherwise like :func:`mjx_runner`.

    Raises:
        ConfigError: its packages, or the GPU that it needs, are missing.
    """
    return _scan(WarpEngine(model).step, qpos, ctrl, model.nv)


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


@dataclass(frozen=True)
class RawOptions:
    """Settings of ``python -m experiments.benchmarks.raw_physics``."""

    task: str = option("ring_peg", "whose model, from its feasible starts")
    batch: int = option(256, "environments", low=1)
    steps: int = option(50, "physics steps per repetition", low=1)
    repeats: int = option(5, "repetitions; the median counts", low=1)


def draw_starts(task: Task, num: int, seed: int = 0) -> np.ndarray:
    """``num`` feasible starts (num, nq), drawn with replacement."""
    starts = np.asarray(task.feasible_starts().qpos)
    return starts[np.random.default_rng(seed).integers(len(starts), size=num)]


def main() -> None:
    """Measures one task and prints a table."""
    chosen = options(RawOptions, "experiments.benchmarks.raw_physics")
    enable_compilation_cache()
    try:
        task = make_task(chosen.task)
        qpos = draw_starts(task, chosen.batch)
    except (ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    speed = compare(task.model, qpos, steps=chosen.steps, repeats=chosen.repeats, stock=True)
    for name, value in speed.items():
        print(f"{name:10s} {value:10,.0f} env-steps/s   {value / speed['native']:5.2f} of native")


if __name__ == "__main__":
    main()
