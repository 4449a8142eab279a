"""Whether a command line of the documentation is one that this repository accepts; nothing of it runs."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pytest

from rcg_jax import __main__ as rcg
from rcg_jax.cli import sweep
from rcg_jax.config import compose as cli
from rcg_jax.config.arguments import parse_arguments

ROOT = Path(__file__).parents[1]

#: How the dataclass of a command's settings is called.
OPTIONS = ("Options", "FeasibleConfig")


def options_of(module: ModuleType) -> type:
    """The settings of a command: the dataclass that its module defines, or imports, for them."""
    found = [x for name, x in vars(module).items() if dataclasses.is_dataclass(x) and name.endswith(OPTIONS)]
    (own,) = [x for x in found if x.__module__ == module.__name__] or found
    return own


def check(words: Sequence[str]) -> None:
    """Fails unless a command line is one that this repository, or the shell, accepts."""
    if "rcg" in words[1:]:  # variables and a launcher before it
        words = words[words.index("rcg") :]
    while "=" in words[0]:
        words = words[1:]
    program, rest = words[0], list(words[1:])
    if program == "rcg":
        assert rest[0] in rcg.COMMANDS
        check(["python", "-m", rcg.COMMANDS[rest[0]][0], *rest[1:]])
    elif program.endswith("python") and rest[:1] == ["-u"]:
        check([program, *rest[1:]])
    elif program.endswith("python") and rest[0] == "-m":
        check_module(rest[1], rest[2:])
    elif program == "make":
        check_make(rest)
    elif program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        for names in re.findall(r"\[(.*?)\]", " ".join(rest)):
            assert set(names.split(",")) <= set(extras)
    elif program == "cp":
        assert all(list(ROOT.glob(word)) for word in rest[:-1])
    else:
        raise AssertionError(f"{program}: unknown to this test")


def check_module(name: str, words: list[str]) -> None:
    if name == "rcg_jax.run":
        request = cli.parse(words)
        if request.multirun:
            sweep.check(request.overrides)
        elif not request.help:
            cli.compose_config(request.overrides)
        return
    if name == "rcg_jax.policies.__main__":
        assert not words
        return
    found = importlib.util.find_spec(name)
    assert found, name
    module = importlib.import_module(f"{name}.__main__" if found.submodule_search_locations else name)
    assert callable(module.main)
    if hasattr(module, "DEFAULTS"):
        assert {word.partition("=")[0] for word in words} <= set(module.DEFAULTS)
    else:
        parse_arguments(options_of(module), words)


def check_make(words: list[str]) -> None:
    """Checks what make would run."""
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    dry = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert dry.returncode == 0, dry.stderr
    for line in dry.stdout.splitlines():
        if re.search(r"-m (rcg_jax|experiments)\b", line):
            check(shlex.split(line))
        elif "gpu.sh" in line:
            parts = re.findall(r"some of: (.*)", (ROOT / "experiments" / "benchmarks" / "gpu.sh").read_text())[0]
            assert set(shlex.split(line)[2:]) <= set(parts.split())
