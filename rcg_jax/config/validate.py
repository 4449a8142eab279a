"""Whether settings can be used: each within its range, and what those of a run require of each other."""

from __future__ import annotations

import dataclasses
import math
import re
from operator import attrgetter
from typing import Any

from rcg_jax.config.settings import Config, ConfigError, flatten

#: The largest port of an address.
_LAST_PORT = 65_535

_TYPES = {
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "list[int]": "a list of integers such as [64,64], each",
}


def requirement(item: dataclasses.Field[Any]) -> str:
    """What a field accepts, in words: its type and its range."""
    meta = item.metadata
    if meta["choices"]:
        return f"one of {', '.join(meta['choices'])}"
    if meta["form"]:
        return str(meta["form"])
    bounds = [
        f"{sign} {meta[name]:.10g}"
        for sign, name in ((">", "above"), (">=", "low"), ("<=", "high"))
        if meta[name] is not None
    ]
    return f"{_TYPES[str(item.type)]} {' and '.join(bounds)}".strip()


def check_value(name: str, item: dataclasses.Field[Any], value: Any, text: str | None = None) -> None:
    """Refuses a value that is not in its field's range; ``text`` is how the user wrote it.

    Raises:
        ConfigError: names the field, its value and what is allowed.
    """
    meta = item.metadata
    low, high, above = meta["low"], meta["high"], meta["above"]
    for one in value if isinstance(value, list | tuple) else [value]:
        if one == "":
            raise ConfigError(f"{name}=: must not be empty")
        if isinstance(one, str):
            ok = not meta["choices"] or one in meta["choices"]
            ok = ok and (not meta["pattern"] or re.fullmatch(meta["pattern"], one) is not None)
        else:
            ok = math.isfinite(one) and (low is None or one >= low) and (high is None or one <= high)
            ok = ok and (above is None or one > above)
        if not ok:
            raise ConfigError(f"{name}={value if text is None else text}: must be {requirement(item)}")


def validate(config: Config) -> None:
    """Checks every field of ``config`` and what they require of each other, but not which tasks and methods there are.

    Raises:
        ConfigError: see :func:`check_value`.
    """
    for name, item, value in flatten(config):
        check_value(name, item, value)

    def require(name: str, ok: bool, what: str) -> None:
        if not ok:
            value = attrgetter(name)(config)
            raise ConfigError(f"{name}={f'{value:g}' if isinstance(value, float) else value}: {what}")

    require("num_seeds", config.seed + config.num_seeds <= 2**31, f"seed + num_seeds - 1 must be <= {2**31 - 1}")
    cur, hosts = config.curriculum, config.hosts
    require("curriculum.r_min", cur.r_min < cur.r_max, f"must be below curriculum.r_max={cur.r_max:g}")
    fits = cur.brownian_horizon <= cur.brownian_horizon_max
    require("curriculum.brownian_horizon_max", fits, f"must be >= curriculum.brownian_horizon={cur.brownian_horizon}")
    starts = cur.num_new + cur.num_old
    fits = starts <= cur.replay_capacity
    require("curriculum.replay_capacity", fits, f"must be >= curriculum.num_new + curriculum.num_old = {starts}")
    num_envs, batch_size = config.rollout.num_envs, config.rollout.batch_size  # 0: left open
    fits = not (num_envs and batch_size and batch_size % num_envs)
    require("rollout.batch_size", fits, f"must be a multiple of rollout.num_envs={num_envs}")
    alone = hosts.coordinator == "none"
    if uses := {"native": "the threads of one CPU", "warp": "one device"}.get(config.engine):
        what = f"engine={config.engine} uses {uses}; must be 1, or engine=mjx"
        require("devices", config.devices == "1", what)
        require("hosts.coordinator", alone, f"engine={config.engine} uses one host; must be none, or engine=mjx")
    varies = [name for name in ("friction", "mass", "damping", "motor") if getattr(config.randomize, name)]
    for name in varies:
        require(f"randomize.{name}", config.engine in ("auto", "native"), f"needs engine=native, not {config.engine}")
    port = hosts.coordinator.rpartition(":")[2]
    fits = not port.isdecimal() or 0 < int(port) <= _LAST_PORT
    require("hosts.coordinator", fits, f"the port must be >= 1 and <= {_LAST_PORT}")
    require("hosts.processes", not alone or hosts.processes == 1, "needs hosts.coordinator=host:port")
    require("hosts.process", hosts.process < hosts.processes, f"must be < hosts.processes={hosts.processes}")
