"""Physics engines behind one batched protocol (:class:`rcg_jax.physics.engine.Engine`)."""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from rcg_jax.physics.engine import Engine
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine

#: Engine constructors by name.
ENGINES: dict[str, Callable[[mujoco.MjModel], Engine]] = {"mjx": MjxEngine, "native": NativeEngine}


def make_engine(name: str, model: mujoco.MjModel) -> Engine:
    """The engine called ``name`` for ``model``.

    Raises:
        ValueError: no such engine; lists the known ones.
    """
    if name not in ENGINES:
        raise ValueError(f"engine={name}: must be one of {', '.join(ENGINES)}")
    return ENGINES[name](model)
