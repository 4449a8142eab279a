"""Python called from compiled programs by a name, so that the programs stay on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from rcg_jax.physics.host_call import host_call


def _weighted(inputs: list[np.ndarray], results: list[np.ndarray]) -> None:
    x, count, flag = inputs
    results[0][:] = np.where(flag[..., None], x * count[..., None], -x)
    results[1][:] = ~flag


def _call(x: Array, count: Array, flag: Array) -> tuple[Array, Array]:
    outputs = [jax.ShapeDtypeStruct(x.shape, x.dtype), jax.ShapeDtypeStruct(flag.shape, jnp.bool_)]
    out, negated = host_call(1, _weighted, outputs, x, count, flag)
    return out, negated


@pytest.mark.parametrize("count_dtype", [jnp.int32, jnp.uint32])
@pytest.mark.parametrize("size", [3, 0])
def test_it_computes_what_the_function_does_under_jit_vmap_and_scan(count_dtype: type, size: int) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(5, 2, 4, size)).astype(np.float32)
    count = rng.integers(0, 9, (5, 2, 4)).astype(count_dtype)
    flag = rng.random((5, 2, 4)) < 0.5
    want = np.where(flag[..., None], x * count[..., None].astype(np.float32), -x)

    def over_axis(_: None, args: tuple[Array, ...]) -> tuple[None, tuple[Array, Array]]:
        return None, jax.vmap(_call)(*args)

    out, negated = jax.jit(lambda *args: jax.lax.scan(over_axis, None, args)[1])(x, count, flag)
    np.testing.assert_array_equal(out, want)
    np.testing.assert_array_equal(negated, ~flag)


def test_what_the_function_raises_is_an_error_with_its_traceback_and_inputs_cannot_be_written() -> None:
    def fails(inputs: list[np.ndarray], results: list[np.ndarray]) -> None:
        inputs[0][:] = 0.0

    with pytest.raises(jax.errors.JaxRuntimeError, match=r"(?s)in fails.*read-only"):
        jax.block_until_ready(host_call(2, fails, [jax.ShapeDtypeStruct((2,), jnp.float32)], jnp.ones(2)))


_PROGRAM = """
import sys
import jax, jax.numpy as jnp, mujoco
from jax._src import monitoring
from rcg_jax.physics.engine import reset
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.physics.native import NativeEngine
enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
events = []
monitoring.register_event_listener(lambda name, **_: events.append(name))
model = mujoco.MjModel.from_xml_path("xml/ring_peg.xml")
model.opt.timestep = float(sys.argv[1])
engine, zeros = NativeEngine(model), jnp.zeros((3, 7))
def fall(state):
    return jax.lax.scan(lambda s, _: (engine.step(s, zeros + 0.1), None), state, length=50)[0]
state = reset(zeros, zeros)
lowered = jax.jit(fall).lower(state)
before = len(events)
compiled = lowered.compile()
hits = events[before:].count("/jax/compilation_cache/cache_hits")
print(float(compiled(state).qpos[0, 0]), hits)
"""


@pytest.mark.parametrize("last", ["kept = run(state)", "run(state)"])
def test_a_program_that_still_runs_at_the_end_of_python_is_waited_for(last: str) -> None:
    code = f"""
import jax, jax.numpy as jnp, mujoco
from rcg_jax.physics.engine import reset
from rcg_jax.physics.native import NativeEngine
engine = NativeEngine(mujoco.MjModel.from_xml_path("xml/ring_peg.xml"))
def fall(state):
    return jax.lax.scan(lambda s, _: (engine.step(s, jnp.zeros((400, 7))), None), state, length=300)[0]
run = jax.jit(fall)
state = reset(jnp.zeros((400, 7)), jnp.zeros((400, 7)))
run.lower(state).compile()
{last}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")


def test_another_process_loads_a_program_with_physics_but_not_that_of_another_model(tmp_path: Path) -> None:
    def run(timestep: float) -> tuple[float, int]:
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PLATFORMS": "cpu"}
        command = [sys.executable, "-c", _PROGRAM, str(timestep)]
        out = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        angle, hits = out.split()
        return float(angle), int(hits)

    first, again, other = run(0.01), run(0.01), run(0.005)
    assert (first[1], again[1], other[1]) == (0, 1, 0)
    assert first[0] == again[0] != other[0]
