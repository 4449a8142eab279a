"""engine=auto: which physics engine suits this machine, found out before JAX starts."""

from __future__ import annotations

import dataclasses
import glob
import importlib.util
from contextlib import suppress

import jax

from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.config.validate import validate
from rcg_jax.physics.variants import SCALES
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.settings import read_config

#: JAX's plugins for accelerators, with the device files that show that there is one.
_PLUGINS = {
    "jax_cuda12_plugin": "/dev/nvidia[0-9]*",
    "jax_cuda13_plugin": "/dev/nvidia[0-9]*",
    "jax_rocm7_plugin": "/dev/kfd",
    "libtpu": "/dev/accel*",
}


def has_accelerator() -> bool:
    """Whether JAX is going to compute on an accelerator; does not start it."""
    if asked := str(getattr(jax.config, "jax_platforms", None) or ""):
        return asked.split(",")[0] != "cpu"
    return any(importlib.util.find_spec(name) is not None and glob.glob(path) for name, path in _PLUGINS.items())


def choose_engine(config: Config) -> tuple[Config, str]:
    """``config`` with an engine in place of ``auto``, and which one it is and why; nothing where it was not auto.

    A run that was begun keeps its engine. Else it is ``native`` on a CPU, unless several devices or hosts are asked
    for, and on an accelerator ``native`` where physics is randomised, ``warp`` where MuJoCo Warp is installed and one
    device is used, or ``mjx``.

    Raises:
        ConfigError: the engine with which the run was begun does not go with several devices or hosts.
    """
    if config.engine != "auto":
        return config, ""
    engine, why = _begun_with(config), "with which the run was begun"
    several = config.devices != "1" or config.hosts.coordinator != "none"
    if not engine and not has_accelerator():
        engine, why = ("mjx", "for several devices") if several else ("native", "the fastest on a CPU")
    elif not engine and any(getattr(config.randomize, name) for name in SCALES):
        engine, why = "native", "which alone has randomised physics"
    elif not engine and not several and importlib.util.find_spec("warp") is not None:
        engine, why = "warp", "MuJoCo Warp is installed, and there is an accelerator"
    elif not engine:
        engine, why = "mjx", "there is an accelerator"
    config = dataclasses.replace(config, engine=engine)
    validate(config)
    return config, f"engine={engine}: {why}"


def _begun_with(config: Config) -> str:
    """The engine that the run which ``config`` continues was begun with; empty where there is none."""
    folder = RunFolder(config, config.seed)
    with suppress(ConfigError):  # then it is refused, with its reason, when the run is opened
        return read_config(folder.path).engine if folder.has_progress() else ""
    return ""
