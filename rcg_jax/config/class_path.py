"""What ``task=``, ``method=`` and ``logger=`` may say: a registered name, or a class of one's own.

That is ``path/to/file.py:ClassName`` or ``package.module:ClassName``.

Nothing here imports JAX or runs the user's code, so that a wrong name is refused at once.
"""

from __future__ import annotations

import ast
import os
import re
import sys
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path

from rcg_jax.config.names import LOGGERS, METHODS, TASKS, did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.console import one_line

#: Registered names, by field.
REGISTERED = {"task": TASKS, "method": METHODS, "logger": LOGGERS}


def forms(field: str) -> str:
    """What a field may say, for messages."""
    return f"one of {', '.join(REGISTERED[field])}, or a class of your own: path/to/file.py:ClassName"


def is_own(name: str) -> bool:
    """Whether ``name`` stands for a class, not for something registered."""
    return ":" in name or name.endswith(".py")


def class_name(name: str) -> str:
    """The last part of a name, for titles and folders: a registered name, or the ClassName."""
    return name.rpartition(":")[2]


def resolve_name(field: str, name: str) -> str:
    """What a field of :data:`REGISTERED` says as a run stores it: with an absolute path, which holds everywhere.

    Raises:
        ConfigError: an unknown name, no such file or module, a file that is no Python, or one without such a class.
    """
    if not is_own(name):
        # Tasks that this program has registered: only one that has imported them can know.
        here = getattr(sys.modules.get("rcg_jax.tasks"), "TASKS", ()) if field == "task" else ()
        if name not in REGISTERED[field] and name not in here:
            hint = did_you_mean(name, REGISTERED[field])
            raise ConfigError(f"{field}={name}: must be {forms(field)}; {hint}".rstrip("; "))
        return name
    where, _, cls = name.rpartition(":") if not name.endswith(".py") else (name, "", "")
    if is_file_form(where):
        path = Path(os.path.expanduser(where)).resolve()  # of "~/..." only: "./~/..." is a folder
        if not path.is_file():
            raise ConfigError(f"{field}={name}: {'no such file' if not path.exists() else 'is no file'}: {path}")
        _check_source(f"{field}={name}", path, cls)
        return f"{path}:{cls}"
    _check_source(f"{field}={name}", _module_source(f"{field}={name}", where), cls)
    return f"{where}:{cls}"


def is_file_form(where: str) -> bool:
    """Whether the part before the colon is a file's path; otherwise it is a module's name."""
    return where.endswith(".py") or "/" in where


def _module_source(setting: str, module: str) -> Path | None:
    """The file of a module, found without importing it or its packages; None if it has no Python source."""
    spec: ModuleSpec | None = None
    path: list[str] | None = None
    try:
        for name in accumulate(module.split("."), "{}.{}".format):
            spec = find_spec(name) if path is None else PathFinder.find_spec(name, path)
            path = list(spec.submodule_search_locations or ()) if spec else []
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        raise ConfigError(f"{setting}: no module {module} in Python's path; for a file write path/to/file.py:ClassName")
    return Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None


def _check_source(setting: str, path: Path | None, cls: str) -> None:
    """Refuses a source that cannot hold the class, by reading it."""
    if path is None:
        return
    try:
        source = path.read_bytes()
        tree = ast.parse(source, filename=str(path))
    except SyntaxError as error:
        raise ConfigError(f"{setting}: {path}, line {error.lineno}: {error.msg}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{setting}: {path} cannot be read: {one_line(error)}") from None
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    known = f"it defines {', '.join(classes)}" if classes else "it defines no class"
    if not cls.isidentifier():
        raise ConfigError(f"{setting}: no class is named; write {path.name}:ClassName ({known})")
    # A class may also be imported or assigned: any other mention of it will do.
    if cls not in classes and not re.search(rf"\b{cls}\b|import \*", source.decode(errors="replace")):
        raise ConfigError(f"{setting}: {path} has no class {cls}; {known}; {did_you_mean(cls, classes)}".rstrip("; "))
