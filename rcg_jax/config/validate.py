"""Whether settings can be used: each within its range, and what those of a run require of each other."""

from __future__ import annotations

import dataclasses
import math
import re
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


def check_value(name: str, item: dataclasses.Field[Any], value: Any) -> None:
    """Refuses a value that is not in its field's range.

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
            raise ConfigError(f"{name}={value}: must be {requirement(item)}")


def validate(config: Config) -> None:
    """Checks every field of ``config`` and what they require of each other, but not which tasks and methods there are.

    Raises:
        ConfigError: see :func:`check_value`.
    """
    for name, item, value in flatten(config):
        check_value(name, item, value)
    if config.seed + config.num_seeds > 2**31:
        raise ConfigError(f"num_seeds={config.num_seeds}: seed + num_seeds - 1 must be <= {2**31 - 1}")
    _check_hosts(config)
    cur, roll, base = config.curriculum, config.rollout, config.baseline
    if cur.r_min >= cur.r_max:
        raise ConfigError(f"curriculum.r_min={cur.r_min:g}: must be below curriculum.r_max={cur.r_max:g}")
    if cur.brownian_horizon_max < cur.brownian_horizon:
        raise ConfigError(
            f"curriculum.brownian_horizon_max={cur.brownian_horizon_max}: "
            f"must be >= curriculum.brownian_horizon={cur.brownian_horizon}"
        )
    if cur.replay_capacity < cur.num_new + cur.num_old:
        raise ConfigError(
            f"curriculum.replay_capacity={cur.replay_capacity}: "
            f"must be >= curriculum.num_new + curriculum.num_old = {cur.num_new + cur.num_old}"
        )
    if roll.num_envs and roll.batch_size and roll.batch_size % roll.num_envs:
        raise ConfigError(
            f"rollout.batch_size={roll.batch_size}: must be a multiple of rollout.num_envs={roll.num_envs}"
        )
    if roll.batch_size and base.minibatch_size > roll.batch_size:
        raise ConfigError(
            f"baseline.minibatch_size={base.minibatch_size}: must be <= rollout.batch_size={roll.batch_size}"
        )


def _check_hosts(config: Config) -> None:
    hosts = config.hosts
    alone = hosts.coordinator == "none"
    uses = {"native": "the threads of one CPU", "warp": "one device"}.get(config.engine)
    if uses and config.devices != "1":
        raise ConfigError(f"devices={config.devices}: engine={config.engine} uses {uses}; must be 1, or engine=mjx")
    if uses and not alone:
        raise ConfigError(
            f"hosts.coordinator={hosts.coordinator}: engine={config.engine} uses one host; must be none, or engine=mjx"
        )
    port = hosts.coordinator.rpartition(":")[2]
    if port.isdecimal() and not 0 < int(port) <= _LAST_PORT:
        raise ConfigError(f"hosts.coordinator={hosts.coordinator}: the port must be >= 1 and <= {_LAST_PORT}")
    if alone and hosts.processes > 1:
        raise ConfigError(f"hosts.processes={hosts.processes}: needs hosts.coordinator=host:port")
    if hosts.process >= hosts.processes:
        raise ConfigError(f"hosts.process={hosts.process}: must be < hosts.processes={hosts.processes}")
