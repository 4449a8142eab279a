"""The XLA-on-CPU trap: MJX with and without the compiler options of :mod:`rcg_jax.physics.jit`.

    python -m experiments.xla_cpu_trap

A chain of hinges without contacts, stepped by plain ``mjx.step`` under jit and vmap. With jax's defaults XLA's fusion
emitters recompute the chain for each of its links, so that every joint more multiplies the cost; the chain here has
only as many joints as keep the slow case within a minute. Prints a table and writes results/xla_cpu_trap.csv.

Exits with 1 where MJX with our options is under a third of the share of ``mujoco.batch`` that it should reach: then
the options have stopped working, after an upgrade of jax for instance.
"""

from __future__ import annotations

import csv
import platform
import shlex
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from experiments.raw_physics import native_runner, throughput
from rcg_jax.physics.jit import compiler_options
from rcg_jax.physics.mjx_import import mjx

RESULT = Path(__file__).parent / "results" / "xla_cpu_trap.csv"
#: Joints, environments, and steps of one run; the slow case gets one step.
JOINTS, BATCH, STEPS = 7, 64, 200
#: Share of raw mujoco.batch on all cores that MJX reaches on this chain with the options (measured on 2 cores).
SHOULD_REACH = 0.25


def chain(joints: int) -> mujoco.MjModel:
    """A chain of ``joints`` hinges about alternating axes, with a motor each and nothing that could collide."""
    opening, closing = "", ""
    for i in range(joints):
        axis = ("0 0 1", "0 1 0", "1 0 0")[i % 3]
        opening += (
            f'<body pos="{0.3 if i else 0} 0 0"><joint name="j{i}" axis="{axis}" damping="1" armature="0.04"/>'
            '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>'
        )
        closing += "</body>"
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-1 1"/>' for i in range(joints))
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>{opening}{closing}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def mjx_runner(
    model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray, options: dict[str, Any]
) -> tuple[Callable[[], None], float]:
    """Steps ``mjx.step`` through ``ctrl`` (T, B, nu); returns the compiled runner and the seconds compiling took."""
    device_model = mjx.put_model(model)
    data = mjx.make_data(device_model)

    def one(state: tuple[Array, Array], ctrl: Array) -> tuple[Array, Array]:
        d = mjx.step(device_model, data.replace(qpos=state[0], qvel=state[1], ctrl=ctrl))
        return d.qpos, d.qvel

    def run(qpos: Array, ctrl: Array) -> tuple[Array, Array]:
        step = jax.vmap(one)
        return jax.lax.scan(lambda s, u: (step(s, u), None), (qpos, jnp.zeros_like(qpos)), ctrl)[0]

    arguments = jnp.asarray(qpos, jnp.float32), jnp.asarray(ctrl)
    begin = time.perf_counter()
    compiled = jax.jit(run, compiler_options=options).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    return lambda: jax.block_until_ready(compiled(*arguments)), seconds


def main() -> int:
    """Measures, prints, writes; returns the exit code."""
    model = chain(JOINTS)
    rng = np.random.default_rng(0)
    qpos = rng.uniform(-1, 1, (BATCH, model.nq))
    ctrl = rng.uniform(-1, 1, (STEPS, BATCH, model.nu)).astype(np.float32)

    fast, fast_seconds = mjx_runner(model, qpos, ctrl, compiler_options())
    slow, slow_seconds = mjx_runner(model, qpos, ctrl[:1], {})
    fast()
    runners = {"mujoco.batch": native_runner(model, qpos, ctrl), "mjx, our options": fast}
    speed = throughput(runners, STEPS * BATCH, repeats=7)
    speed |= throughput({"mjx, jax's defaults": slow}, BATCH, repeats=1)

    native = speed["mujoco.batch"]
    compiling = {"mjx, our options": fast_seconds, "mjx, jax's defaults": slow_seconds}
    print(f"chain of {JOINTS} hinges, {BATCH} environments, jax {jax.__version__}, {_cpu()}")
    print(f"{'':22s}{'env-steps/s':>14s}{'of mujoco.batch':>18s}{'compiling':>12s}")
    rows = []
    for name, value in speed.items():
        seconds = compiling.get(name)
        print(f"{name:22s}{value:14,.1f}{value / native:18.5f}" + (f"{seconds:10.1f} s" if seconds else ""))
        rows.append(
            {
                "case": name,
                "env_steps_per_second": f"{value:.4g}",
                "ratio": f"{value / native:.4g}",
                "compile_seconds": f"{seconds:.3g}" if seconds else "",
                "joints": JOINTS,
                "batch": BATCH,
                "options": " ".join(f"{k}={v}" for k, v in compiler_options().items())
                if name.endswith("our options")
                else "",
                "jax": jax.__version__,
                "jaxlib": version("jaxlib"),
                "mujoco": mujoco.__version__,
                "cpu": _cpu(),
                "command": shlex.join(["python", "-m", "experiments.xla_cpu_trap", *sys.argv[1:]]),
            }
        )
    RESULT.parent.mkdir(exist_ok=True)
    with RESULT.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

    ratio = speed["mjx, our options"] / native
    if ratio < SHOULD_REACH / 3:
        print(f"MJX reaches {ratio:.3f} of mujoco.batch; it should reach {SHOULD_REACH}, and a third of that at least.")
        return 1
    return 0


def _cpu() -> str:
    """Model name and number of cores of this machine's processor."""
    import os

    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} cores"


if __name__ == "__main__":
    sys.exit(main())
