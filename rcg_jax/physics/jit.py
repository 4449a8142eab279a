"""How this project compiles: jit with full float32 products and the CPU options MJX needs, and a persistent cache.

JAX lets an NVIDIA GPU round the factors of float32 matrix products to TF32, 10 bits of mantissa of 23. Conjugate
gradients on Fisher products and MJX's kinematics need all of them, and it costs nothing that shows, so float32 is the
default of :func:`jit`; the setting ``matmul_precision`` changes it. On a CPU all of its values compute the same.

XLA's CPU compiler likes to compute a value again for each of its users instead of storing it. Two options stop that:

- ``xla_cpu_use_fusion_emitters=False``. The emitters recompute a kinematic chain once per consumer, which grows
  exponentially with its depth: MJX on a 7-joint arm runs at a few steps per second with them, at tens of thousands
  without. Programs without such a chain take half the time with them, so the engine says whether its programs want them
  (:class:`rcg_jax.physics.engine.Engine`).
- ``xla_disable_hlo_passes=cse_barrier_expander``. That pass removes ``jax.lax.optimization_barrier`` before fusion;
  with the barriers in place our constraint solver takes a third of the time.

Both are passed per function, because there an unknown option raises, whereas an unknown word in ``XLA_FLAGS`` ends the
process. Only the options of the outermost jit count, so every entry point of this package uses :func:`jit`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import tempfile
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax._src import core  # trace_state_clean has no public name

_SETTINGS: Any = jax.config  # which has no types for what is read here

_NO_EMITTERS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
_KEEP_BARRIERS: dict[str, Any] = {"xla_disable_hlo_passes": "cse_barrier_expander"}


@functools.cache
def compiler_options(fusion_emitters: bool = False) -> dict[str, Any]:
    """Compiler options for the default backend: on a CPU those that its XLA knows, elsewhere none."""
    if jax.default_backend() != "cpu":
        return {}
    wanted = _KEEP_BARRIERS if fusion_emitters else {**_NO_EMITTERS, **_KEEP_BARRIERS}
    return {name: value for name, value in wanted.items() if _known(name, value)}


@functools.cache
def _known(name: str, value: Any) -> bool:
    """Whether this jaxlib has the compiler option ``name``."""
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except Exception as error:  # JaxRuntimeError; its import path moved between releases
        if "compile option" not in str(error):
            raise
        return False
    return True


@contextlib.contextmanager
def _float32() -> Iterator[None]:
    """Context in which numbers are float32, in a program that has float64 on."""
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Explicitly requested dtype float64")
        yield


def jit(
    fun: Callable[..., Any], *, fusion_emitters: bool = False, matmul_precision: str = "float32", **kwargs: Any
) -> Any:
    """``jax.jit`` with :func:`compiler_options`, looked up at the first call so that importing starts no backend.

    Args:
        fun, **kwargs: as for ``jax.jit``.
        fusion_emitters: as the engine of its physics says; False is safe for all.
        matmul_precision: of its matrix products, one of :data:`rcg_jax.config.settings.MATMUL_PRECISIONS`.

    Returns:
        The compiled function, with ``lower`` and ``__wrapped__``. It may be called inside other transformations of JAX,
        where how it is compiled is up to the outermost jit: with this one MJX keeps its speed on a CPU.
    """

    @functools.wraps(fun)
    def traced(*args: Any, **kw: Any) -> Any:
        if matmul_precision == "default":  # JAX's own, or what JAX_DEFAULT_MATMUL_PRECISION says
            return fun(*args, **kw)
        with jax.default_matmul_precision(matmul_precision):  # here, where a call that is compiled does not wait for it
            return fun(*args, **kw)

    @functools.cache
    def compiled(outermost: bool) -> Any:
        # Inside somebody else's jit, vmap or scan the options are those of the outermost jit; JAX takes no others.
        return jax.jit(traced, compiler_options=compiler_options(fusion_emitters) if outermost else None, **kwargs)

    @functools.wraps(fun)
    def call(*args: Any, **kw: Any) -> Any:
        with _float32() if _SETTINGS.jax_enable_x64 else contextlib.nullcontext():
            return compiled(core.trace_state_clean())(*args, **kw)

    def lower(*args: Any, **kw: Any) -> Any:
        with _float32() if _SETTINGS.jax_enable_x64 else contextlib.nullcontext():
            return compiled(True).lower(*args, **kw)

    call.lower = lower  # type: ignore[attr-defined]
    return call


def enable_compilation_cache() -> Path | None:
    """Keeps compiled programs on disk between processes; returns the folder, None where there is none to be had.

    One folder per jaxlib version and processor, also below ``JAX_COMPILATION_CACHE_DIR``, which several machines may
    share. Where a program has set JAX's own setting, that stands. JAX keeps no programs with callbacks of its own;
    ``engine=native`` calls C MuJoCo by :mod:`rcg_jax.physics.host_call`, whose programs are kept.
    """
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    configured = _SETTINGS.jax_compilation_cache_dir
    if configured and configured != given:
        return Path(configured)
    try:
        home = Path(given or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / ("" if given else "rcg_jax") / f"jaxlib-{version('jaxlib')}-{_cpu_id()}"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):  # no home, or not ours to write to: the run compiles what it needs
        jax.config.update("jax_compilation_cache_dir", None)
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    return folder


def _cpu_id() -> str:
    """Short hash of what XLA compiles for: processor model and its instruction set flags."""
    text = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        text += "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    except OSError:
        pass
    return hashlib.sha256(text.encode()).hexdigest()[:12]
