"""What ``task=`` and ``method=`` may say: a registered name, or a class of one's own as ``path/to/file.py:ClassName``
or ``package.module:ClassName``.

Nothing here imports JAX or runs the user's code, so that a wrong name is refused at once.
"""

from __future__ import annotations

import ast
import difflib
import os
import sys
from collections.abc import Collection
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path

from rcg_jax.config.names import METHODS, TASKS
from rcg_jax.config.settings import ConfigError

#: Registered names, by field.
REGISTERED = {"task": TASKS, "method": METHODS}


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
    """``name`` in the form that a run stores: with an absolute path, so that it holds in every working directory.

    Args:
        field: ``task`` or ``method``.
        name: what ``field=`` says.

    Raises:
        ConfigError: one line that says what is wrong: an unknown name, no such file or module, a file that is no
            Python, or one without such a class.
    """
    if not is_own(name):
        if name not in REGISTERED[field] and name not in _registered_here(field):
            near = difflib.get_close_matches(name, REGISTERED[field], n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(f"{field}={name}: must be {forms(field)}{hint}")
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


def _registered_here(field: str) -> Collection[str]:
    """Tasks that this program has registered, of which only one that has imported them can know."""
    tasks = sys.modules.get("rcg_jax.tasks") if field == "task" else None
    return getattr(tasks, "TASKS", ())


def is_file_form(where: str) -> bool:
    """Whether the part before the colon is a file's path; otherwise it is a module's name."""
    return where.endswith(".py") or "/" in where


def _module_source(setting: str, module: str) -> Path | None:
    """The file of a module, found without importing it or its packages; None if it has no Python source."""
    path: list[str] | None = None
    spec: ModuleSpec | None = None
    parts = module.split(".")
    try:
        for i, part in enumerate(parts):
            full = ".".join(parts[: i + 1])
            spec = find_spec(part) if i == 0 else PathFinder.find_spec(full, path)
            if spec is None:
                raise ModuleNotFoundError(full)
            path = list(spec.submodule_search_locations or ())
    except (ImportError, ValueError):
        raise ConfigError(
            f"{setting}: no module {module} in Python's path; for a file write path/to/file.py:ClassName"
        ) from None
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None


def _check_source(setting: str, path: Path | None, cls: str) -> None:
    """Refuses a source that cannot hold the class, by reading it.

    Raises:
        ConfigError: unreadable, not Python, or nothing in it is called ``cls``.
    """
    if path is None:
        return
    try:
        tree = ast.parse(path.read_bytes(), filename=str(path))
    except SyntaxError as error:
        raise ConfigError(f"{setting}: {path}, line {error.lineno}: {error.msg}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{setting}: {path} cannot be read: {' '.join(str(error).split())}") from None
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    known = f"it defines {', '.join(classes)}" if classes else "it defines no class"
    if not cls.isidentifier():
        raise ConfigError(f"{setting}: no class is named; write {path.name}:ClassName ({known})")
    # A class may also be imported or assigned, anywhere at the top level: any other mention of it will do.
    if cls not in classes and not _mentions(tree, cls):
        near = difflib.get_close_matches(cls, classes, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(f"{setting}: {path} has no class {cls}; {known}{hint}")


def _mentions(tree: ast.Module, cls: str) -> bool:
    """Whether the module may bind ``cls`` other than by a plain class statement."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id == cls and isinstance(node.ctx, ast.Store):
            return True
        if isinstance(node, ast.ClassDef) and node.name == cls:
            return True
        names = node.names if isinstance(node, ast.ImportFrom | ast.Import) else []
        if any((alias.asname or alias.name) in (cls, "*") for alias in names):
            return True
    return False
