"""The settings that a run's folder holds, and in which of them another run would differ."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcg_jax.config.compose import make_schema, show
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.io.console import one_line

#: Settings that a run may continue with changed: they do not touch what training computes, or its rounding alone. A
#: preset's name does not count either, because each value that it sets does.
_FREE = (
    *("preset", "num_seeds", "iterations", "run_dir", "eval_every", "checkpoint_every", "write_report", "logger"),
    *("devices", "matmul_precision"),
)

#: Settings, and groups, that are younger than runs that may be continued, with defaults that do what was done before.
_YOUNGER = ("algorithm", "ppo.", "randomize.")

#: Groups of free settings.
_FREE_GROUPS = ("evaluation.", "hosts.")


def is_free(name: str) -> bool:
    """Whether the setting may differ when a run continues."""
    return name in _FREE or name.startswith(_FREE_GROUPS)


def _read_yaml(path: Path) -> DictConfig:
    try:
        tree = OmegaConf.load(path)
    except Exception as error:  # OSError, or one of several of the parser's own
        raise ConfigError(f"{path}: cannot be read: {one_line(error, 160)}") from None
    if not isinstance(tree, DictConfig):
        raise ConfigError(f"{path}: cannot be read: it holds no settings")
    return tree


def read_values(path: Path) -> dict[str, Any]:
    """Settings of a ``config.yaml`` by dotted name.

    Raises:
        ConfigError: the file cannot be read.
    """
    values: dict[str, Any] = {}
    tree: Any = OmegaConf.to_container(_read_yaml(path))
    for name, value in tree.items():
        if isinstance(value, dict):
            values |= {f"{name}.{inner}": each for inner, each in value.items()}
        else:
            values[name] = value
    return values


def differences(old: Mapping[str, Any], new: Config, open_: Collection[str] = ()) -> list[str]:
    """Settings in which a run would change, ``name old -> new``: other than the free ones and those in ``open_``.

    A run from before a setting of :data:`_YOUNGER` was made had what is its default.
    """
    values = {name: value for name, _, value in flatten(new)}
    old = {**{name: value for name, _, value in flatten(Config()) if name.startswith(_YOUNGER)}, **old}
    names = [name for name in dict.fromkeys([*values, *old]) if not is_free(name) and name not in open_]
    return [
        f"{name} {old.get(name, '(absent)')} -> {values.get(name, '(absent)')}"
        for name in names
        if name not in old or name not in values or old[name] != values[name]
    ]


def old_words(old: Mapping[str, Any], names: Collection[str]) -> str:
    """``: name=value ...`` of some of a run's settings, as for the command line; nothing where there is no such."""
    present = {name for name, _, _ in flatten(Config())}
    if any(name not in present or old.get(name) is None for name in names):
        return ""
    return f": {' '.join(f'{name}={_word(old[name])}' for name in names)}"


def _word(value: Any) -> str:
    return str(value) if isinstance(value, float) else show(value)  # all digits


def read_config(run: Path) -> Config:
    """The resolved settings of the run in a seed's folder.

    Raises:
        ConfigError: no run there, or its settings do not fit this program.
    """
    path = run / "config.yaml"
    if not path.exists():
        raise ConfigError(f"run={run}: no config.yaml there; a run's folder is <run_dir>/<task>/<method>/seed<k>")
    try:
        config = OmegaConf.to_object(OmegaConf.merge(make_schema(), _read_yaml(path)))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{path}: {one_line(error, 160)}") from None
    assert isinstance(config, Config)
    return config
