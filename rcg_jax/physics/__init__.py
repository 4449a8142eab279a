"""Physics engines behind one batched protocol (:class:`rcg_jax.physics.engine.Engine`)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import mujoco

from rcg_jax.physics.engine import Engine
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine
from rcg_jax.physics.warp import WarpEngine, check_warp

#: Engine constructors by name.
ENGINES: dict[str, Callable[[mujoco.MjModel], Engine]] = {
    engine.name: engine for engine in (MjxEngine, NativeEngine, WarpEngine)
}


def check_engine(name: str) -> None:
    """Whether there is an engine called ``name`` and it runs on this device.

    Raises:
        ValueError: no such engine; lists the known ones.
        RuntimeError: it does not run on this device, or JAX has none.
        ConfigError: its packages, or the GPU that it needs, are missing.
    """
    if name not in ENGINES:
        raise ValueError(f"engine={name}: must be one of {', '.join(ENGINES)}")
    try:
        _start(name)
    except Exception as error:  # of a plugin that is not there, an AssertionError without words
        asked = getattr(jax.config, "jax_platforms") or "any"  # noqa: B009
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RuntimeError(
            f"JAX cannot start its backend ({asked}; set by JAX_PLATFORMS or jax_platforms): {reason[:200]}; "
            "JAX_PLATFORMS=cpu computes on the CPU"
        ) from error
    if name == NativeEngine.name and jax.default_backend() != "cpu":
        raise RuntimeError(
            f"engine=native runs on a CPU only; the JAX backend is {jax.default_backend()}; a program that wants it "
            'sets JAX_PLATFORMS=cpu, or calls jax.config.update("jax_platforms", "cpu") before it computes anything'
        )
    if name == WarpEngine.name:
        check_warp()


def _start(name: str) -> None:
    """Starts JAX's backend; for engine=native, where the one asked for is not there, that of the CPU."""
    try:
        jax.devices()
    except Exception:
        if name != NativeEngine.name:
            raise
        jax.config.update("jax_platforms", "cpu")
        jax.devices()


def make_engine(name: str, model: mujoco.MjModel) -> Engine:
    """The engine called ``name`` for ``model``.

    Raises:
        UnsupportedModelError: it cannot simulate the model.
        Exception: as :func:`check_engine`.
    """
    check_engine(name)
    return ENGINES[name](model)
