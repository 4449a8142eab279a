"""Settings ``name=value`` of the commands beside training, such as evaluate."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rcg_jax.config.names import did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.config.validate import check_value, requirement
from rcg_jax.io.console import tell

Options = TypeVar("Options")


def parse_arguments(cls: type[Options], argv: Sequence[str]) -> Options:
    """Reads settings into a dataclass of int, float or str :func:`options <rcg_jax.config.settings.option>`.

    Raises:
        ConfigError: not of the form name=value, an unknown name, a value of another type or out of range.
    """
    fields = {item.name: item for item in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for text in argv:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"{text}: cannot be read; write name=value, with one of {', '.join(fields)}")
        if name not in fields:
            hint = did_you_mean(name, fields) or f"settings are {', '.join(fields)}"
            raise ConfigError(f"{text}: unknown setting {name}; {hint}")
        item = fields[name]
        try:
            values[name] = {"int": int, "float": float, "str": str}[str(item.type)](value)
        except ValueError:
            raise ConfigError(f"{text}: must be {requirement(item)}") from None
        check_value(name, item, values[name])
    return cls(**values)


def describe_arguments(cls: type[Any], program: str) -> str:
    """Usage text: every setting with its default, meaning and allowed values."""
    names = [item.name for item in dataclasses.fields(cls)]
    subject = "run=DIR | policy=NAME" if "policy" in names else "run=DIR"
    lines = [f"usage: python -m {program} {subject} [name=value ...]", ""]
    for item in dataclasses.fields(cls):
        meta = item.metadata
        unit = f" [{meta['unit']}]" if meta["unit"] else ""
        lines.append(f"  {item.name}={item.default}{unit}".ljust(26) + f" {meta['help']} ({requirement(item)})")
    return "\n".join(lines)


def run_command(
    cls: type[Options],
    program: str,
    argv: Sequence[str],
    action: Callable[[Options], None],
    refusals: tuple[type[Exception], ...] = (ConfigError,),
) -> int:
    """The command line of a program that needs ``run=DIR``, or ``policy=NAME`` if it has such a setting.

    Args:
        cls: its settings; see :func:`parse_arguments`.
        program: its module.
        argv: what the user wrote.
        action: what it does.
        refusals: exceptions that say in one line why it cannot be done.

    Returns:
        Exit code: 0 done, 2 refused, 130 interrupted.
    """
    if "-h" in argv or "--help" in argv:
        print(describe_arguments(cls, program))
        return 0
    try:
        options = parse_arguments(cls, argv)
        given = [name for name in ("run", "policy") if getattr(options, name, "")]
        if not given:
            other = ", or policy=NAME" if hasattr(options, "policy") else ""
            raise ConfigError(f"run=DIR{other} is missing; a run's folder is <run_dir>/<task>/<method>/seed<k>")
        if len(given) > 1:
            raise ConfigError("run=... and policy=...: one of them, not both")
        action(options)
    except refusals as error:
        tell(error)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return 0
