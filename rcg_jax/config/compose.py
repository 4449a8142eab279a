"""From the command line to a checked :class:`Config`: Hydra composition, one-line errors, the help text.

Nothing here imports JAX, so help and refusals come at once.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcg_jax.config.class_path import REGISTERED, forms, resolve_name
from rcg_jax.config.presets import PRESETS
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.config.validate import requirement, validate

#: Name of the root configuration in Hydra's ConfigStore.
CONFIG_NAME = "config"

#: Hydra's own options that are passed on to it.
HYDRA_FLAGS = ("--cfg", "-c", "--info", "-i", "--resolve", "--package", "-p", "--hydra-help", "--version")


@dataclass(frozen=True)
class Request:
    """What the command line asks for: ``name=value`` settings, -h, -m, any of Hydra's own options."""

    overrides: tuple[str, ...]
    help: bool = False
    multirun: bool = False
    hydra: bool = False


def parse(argv: Sequence[str]) -> Request:
    """Splits arguments into settings and options.

    Raises:
        ConfigError: an option that does not exist.
    """
    overrides: list[str] = []
    own, previous = ("-h", "--help", "-m", "--multirun"), ""
    for word in argv:
        is_option = word.startswith("-")
        if is_option and word not in own and word.partition("=")[0] not in HYDRA_FLAGS:
            options = ", ".join((*own, *HYDRA_FLAGS))
            raise ConfigError(f"{word}: no such option; options are {options}; settings name=value")
        is_value = previous in HYDRA_FLAGS and "=" not in word  # of that option, such as "job" of "--cfg job"
        if not is_option and not is_value:
            overrides.append(word)
        previous = word
    return Request(
        overrides=tuple(overrides),
        help="-h" in argv or "--help" in argv,
        multirun="-m" in argv or "--multirun" in argv,
        hydra=any(word.partition("=")[0] in HYDRA_FLAGS for word in argv),
    )


def make_schema() -> DictConfig:
    """All defaults as an OmegaConf tree, with the types of :class:`Config`; other values can be merged into it."""
    schema = OmegaConf.structured(Config)
    # OmegaConf makes frozen dataclasses read-only; overrides need to write before the frozen object is built.
    for node in (schema, *(schema._get_node(name) for name in schema)):
        node._set_flag("readonly", None)
    return schema


def register() -> None:
    """Puts the schema and the presets into Hydra's ConfigStore; calling it again changes nothing."""
    store = ConfigStore.instance()
    store.store(name="schema", node=make_schema())
    for name, values in PRESETS.items():
        node = OmegaConf.create({"preset": name})
        for key, value in values.items():
            OmegaConf.update(node, key, value)
        store.store(group="preset", name=name, package="_global_", node=node)
    # The order is the precedence: defaults, then the preset, then what the user says.
    defaults = ["schema", {"preset": "default"}, "_self_", {"override hydra/job_logging": "none"}]
    store.store(name=CONFIG_NAME, node={"defaults": defaults})


def _fields() -> dict[str, dataclasses.Field[Any]]:
    return {name: item for name, item, _ in flatten(Config())}


def _requirement(name: str) -> str:
    """What a field accepts, in words."""
    return forms(name) if name in REGISTERED else requirement(_fields()[name])


def parse_overrides(overrides: Sequence[str]) -> list[Override]:
    """Parses settings with Hydra's grammar.

    Raises:
        ConfigError: not of the form name=value, or an unknown name (with the nearest one that exists).
    """
    fields = _fields()
    parser = OverridesParser.create()
    result = []
    for text in overrides:
        try:
            override = parser.parse_override(text)
        except (HydraException, OmegaConfBaseException):
            what = "cannot be read; write name=value, and quote unusual characters: name='a b'"
            raise ConfigError(f"{text}: {what}") from None
        name = override.key_or_group
        if name not in fields and re.split("[./]", name)[0] != "hydra":
            raise ConfigError(f"{text}: {_unknown(name)}")
        if name in fields and text[0] in "+~":
            raise ConfigError(f"{text}: fields are set with {name}=value, without {text[0]}")
        result.append(override)
    return result


def _unknown(name: str) -> str:
    """What to say of a name that is no field's."""
    fields = _fields()
    inside = [field for field in fields if field.startswith(f"{name}.")]
    if inside:
        return f"{name} is a group; set one of its fields: {', '.join(inside)}"
    last = name.split(".")[-1]
    near = [field for field, item in fields.items() if last and item.metadata["symbol"] == last]
    near += difflib.get_close_matches(name, fields, n=1, cutoff=0.5)
    near += [field for field in fields if field.split(".")[-1] == last]
    top = dict.fromkeys(field.split(".")[0] + "." * ("." in field) for field in fields)
    hint = f"did you mean {near[0]}?" if near else f"fields and groups are {', '.join(top)}"
    return f"unknown field {name}; {hint} (--help lists all)"


def given_names(overrides: Sequence[str]) -> frozenset[str]:
    """The settings that ``name=value`` words set."""
    return frozenset(override.key_or_group for override in parse_overrides(overrides))


def compose_config(overrides: Sequence[str]) -> Config:
    """Composes defaults, preset and ``name=value`` settings, of which later ones win, and validates the result.

    Paths of own classes become absolute. What the task's class asks for comes with
    :func:`rcg_jax.tasks.training.resolve`, which imports it.

    Raises:
        ConfigError: unknown field, wrong type, or a value that is not allowed.
    """
    tree, fields, settings = make_schema(), _fields(), parse_overrides(overrides)
    presets = [str(each.value()) for each in settings if each.key_or_group == "preset"]
    for name, value in PRESETS.get(presets[-1], {}).items() if presets else ():
        OmegaConf.update(tree, name, value)
    for each in settings:
        name, text = each.key_or_group, each.input_line
        if each.is_sweep_override():
            raise ConfigError(f"{text}: several values need -m (one run per value)")
        if name not in fields:
            raise ConfigError(f"{text}: is about the runs of a sweep; needs -m")
        try:
            OmegaConf.update(tree, name, each.value())
        except OmegaConfBaseException:
            raise ConfigError(f"{text}: must be {_requirement(name)}") from None
    try:
        config = OmegaConf.to_object(tree)
    except OmegaConfBaseException as error:
        name = getattr(error, "full_key", None) or "settings"
        raise ConfigError(f"{name}: {str(error).splitlines()[0]}") from None
    assert isinstance(config, Config)
    validate(config)
    named: dict[str, Any] = {name: resolve_name(name, getattr(config, name)) for name in REGISTERED}
    return dataclasses.replace(config, **named)


def show(value: Any) -> str:
    """A setting's value as the command line has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ",".join(map(str, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


_HELP = f"""\
Reverse curriculum generation for reinforcement learning (Florensa et al., 2017).

usage: python -m rcg_jax.run [name=value ...] [-m] [--help]

  python -m rcg_jax.run task=ring_peg                        train; the same command resumes a stopped run
  python -m rcg_jax.run task=ring_peg iterations=160         continue a finished run
  python -m rcg_jax.run task=ring_peg preset=paper num_seeds=5
  python -m rcg_jax.run task=ring_peg devices=all            environments spread over several devices
  python -m rcg_jax.run task=path/to/file.py:ClassName       a task of your own (docs/custom_tasks.md)
  python -m rcg_jax.run task=model.xml                       or gymnasium:Reacher-v5, playground:PointMass
  python -m rcg_jax.run -m method=reverse,uniform seed=0,1   one run for each combination
  python -m rcg_jax.run -m hydra/launcher=joblib seed=0,1    side by side; on a cluster, submitit_slurm
                                                             (docs/reproduce.md)

A seed k writes config.yaml, metrics.csv, eval.csv, starts.csv, tensorboard/, checkpoints/ and, at its end,
policy.npz and report.html into <run_dir>/<task>/<method>/seed<k>/. The fields of a sweep that this path does
not show are added to run_dir.
A task's class may ask for other defaults (the ant's: trpo.max_kl=0.03); a run says which, and yours win.
Ctrl-C finishes the iteration, saves and stops; a second Ctrl-C stops at once.
Hydra's options work too: {", ".join(HYDRA_FLAGS)}."""


def help_text() -> str:
    """Every setting with its default, meaning, unit, paper symbol and allowed values, and how to use them."""
    lines, config, shown = [_HELP, "", Config.__doc__ or ""], Config(), ""
    for name, item, default in flatten(config):
        group = name.rpartition(".")[0]
        if group != shown:
            lines += ["", f"{group}: {(getattr(config, group).__doc__ or '').splitlines()[0]}"]
            shown = group
        meta = item.metadata
        unit = f" [{meta['unit']}]" if meta["unit"] else ""
        symbol = f"   paper: {meta['symbol']}" if meta["symbol"] else ""
        lines.append(f"  {name}={show(default)}{unit}{symbol}")
        lines += textwrap.wrap(
            f"{meta['help']} ({_requirement(name)})", 112, initial_indent=" " * 8, subsequent_indent=" " * 8
        )
    for name, values in PRESETS.items():
        if values:
            settings = ", ".join(f"{key}={show(value)}" for key, value in values.items())
            lines += ["", *textwrap.wrap(f"preset={name} sets: {settings}; your own settings win.", 118)]
    return "\n".join(lines)
