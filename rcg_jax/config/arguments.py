"""Settings ``name=value`` of the commands beside training, such as evaluate."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rcg_jax.config.names import did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.config.validate import check_value, requirement
from rcg_jax.io.console import lenient_output, tell
from rcg_jax.io.starts_file import StartsFileError

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
        check_value(name, item, values[name], value)
    return cls(**values)


def describe_arguments(cls: type[Any], program: str, instead: Sequence[str] = ()) -> str:
    """Usage text: every setting with its default, meaning and allowed values. ``instead`` as in :func:`run_command`."""
    subject = " | ".join(["run=DIR", *(f"{name}=NAME" for name in instead)])
    lines = [f"usage: python -m {program} {subject} [name=value ...]", ""]
    for item in dataclasses.fields(cls):
        meta = item.metadata
        unit = f" [{meta['unit']}]" if meta["unit"] else ""
        lines.append(f"  {item.name}={item.default}{unit}".ljust(26) + f" {meta['help']} ({requirement(item)})")
    return "\n".join(lines)


def output_file(text: str, *suffixes: str) -> Path | None:
    """The file that ``out=`` names; None where it is not set.

    Raises:
        ConfigError: it does not end in one of ``suffixes``, or its folder does not exist.
    """
    if not text:
        return None
    out = Path(text)
    if out.suffix not in suffixes:
        raise ConfigError(f"out={out}: must end in {suffixes[0]}")
    if not out.parent.is_dir():
        raise ConfigError(f"out={out}: no such folder {out.parent}")
    return out


def run_command(
    cls: type[Options],
    program: str,
    argv: Sequence[str] | None,
    action: Callable[[Options, Sequence[str]], None],
    *,
    instead: Sequence[str] = (),
    refusals: tuple[type[Exception], ...] = (ConfigError, StartsFileError),
) -> int:
    """The command line of a small program that needs ``run=DIR`` and has a setting ``out``.

    Args:
        cls: its settings; see :func:`parse_arguments`.
        program: its module.
        argv: what the user wrote; None: the command line of this process.
        action: what it does, given the settings and the words that they were read from.
        instead: settings that may take the place of ``run``.
        refusals: exceptions that say in one line why it cannot be done.

    Returns:
        Exit code: 0 done, 2 refused, 130 interrupted.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    with lenient_output():
        if "-h" in words or "--help" in words:
            print(describe_arguments(cls, program, instead))
            return 0
        try:
            options = parse_arguments(cls, words)
            given = [name for name in ("run", *instead) if getattr(options, name)]
            if not given:
                other = "".join(f", or {name}=NAME" for name in instead)
                raise ConfigError(f"run=DIR{other} is missing; a run's folder is <run_dir>/<task>/<method>/seed<k>")
            if len(given) > 1:
                raise ConfigError(f"{given[0]}=... and {given[1]}=...: one of them, not both")
            action(options, words)
        except refusals as error:
            tell(error)
            return 2
        except OSError as error:
            where = error.filename or f"out={vars(options)['out'] or getattr(options, given[0])}"
            refusal = ConfigError(f"{where}: {error.strerror}" if error.strerror else str(error))
            refusal.__cause__ = error  # with its traceback, where code of the user's raised it
            tell(refusal)
            return 2
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            return 130
        return 0
