"""How this project compiles: jit with the CPU options MJX needs, and a persistent cache.

On a CPU, XLA's fusion emitters recompute a kinematic chain once per consumer, which grows exponentially with the
chain's depth: MJX on a 7-joint arm runs at a few steps per second. ``xla_cpu_use_fusion_emitters=False`` brings back
tens of thousands (``experiments/xla_cpu_trap.py`` measures both). The option is passed per function, because an
option unknown to some jaxlib raises there, whereas an unknown word in ``XLA_FLAGS`` ends the process; and it is
passed on CPU only. Only the options of the outermost jit count, so every entry point of this package uses
:func:`jit` below.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jaxlib

_CPU_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Compiler options for the default backend; empty where it is no CPU or its XLA does not know them."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=_CPU_OPTIONS).lower(0.0).compile()
    except Exception as error:  # JaxRuntimeError; its import path moved between releases
        if "compile option" not in str(error):
            raise
        return {}
    return dict(_CPU_OPTIONS)


def jit(fun: Callable[..., Any], **kwargs: Any) -> Any:
    """``jax.jit`` with :func:`compiler_options`, looked up at the first call so that importing starts no backend.

    Args:
        fun: function to compile.
        **kwargs: arguments of ``jax.jit``.

    Returns:
        The compiled function, with ``lower`` like one of ``jax.jit``.
    """

    @functools.cache
    def compiled() -> Any:
        return jax.jit(fun, compiler_options=compiler_options(), **kwargs)

    @functools.wraps(fun)
    def call(*args: Any, **kw: Any) -> Any:
        return compiled()(*args, **kw)

    call.lower = lambda *args, **kw: compiled().lower(*args, **kw)  # type: ignore[attr-defined]
    return call


def enable_compilation_cache() -> Path:
    """Keeps compiled programs on disk between processes; returns the folder.

    One folder per jaxlib version and CPU model, because programs are compiled for the exact processor. The variable
    ``JAX_COMPILATION_CACHE_DIR`` overrides it. Programs with host callbacks (``engine=native``) are never cached by
    JAX.
    """
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if given:
        folder = Path(given)
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        folder = base / "rcg_jax" / f"jaxlib-{jaxlib.__version__}-{_cpu_id()}"
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
