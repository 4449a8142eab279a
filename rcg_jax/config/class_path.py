"""What ``task=``, ``method=`` and ``logger=`` may say: a registered name, or a class of one's own.

That is ``path/to/file.py:ClassName`` or ``package.module:ClassName``. A task may also be a model's file,
``path/to/model.xml:POINT@KEYFRAME``, or an environment, ``gymnasium:ENV_ID`` or ``playground:ENV``.

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
from xml.etree import ElementTree

from rcg_jax.config.names import LOGGERS, METHODS, TASKS, did_you_mean
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.console import one_line

#: Whose environments ``task=`` takes: the module that has to be there, and how it is installed.
ENVIRONMENTS = {
    "gymnasium": ("gymnasium", 'pip install "rcg_jax[gymnasium]"'),
    "playground": ("mujoco_playground", 'pip install "rcg_jax[playground]"'),
}

#: Registered names, by field.
REGISTERED = {"task": TASKS, "method": METHODS, "logger": LOGGERS}


def forms(field: str) -> str:
    """What a field may say, for messages."""
    own = f"one of {', '.join(REGISTERED[field])}, or a class of your own: path/to/file.py:ClassName"
    return f"{own}; or path/to/model.xml:POINT, gymnasium:ENV_ID, playground:ENV" if field == "task" else own


def is_own(name: str) -> bool:
    """Whether ``name`` stands for a class, not for something registered."""
    return ":" in name or name.endswith(".py")


def split_model(name: str) -> tuple[str, str, str] | None:
    """File, point and keyframe, which may be empty, of ``path/to/model.xml:POINT@KEYFRAME``; None for other names."""
    match = re.fullmatch(r"(.+?\.xml)(?::([^@]*))?(?:@(.*))?", name)
    return (match[1], match[2] or "", match[3] or "") if match else None


def split_environment(name: str) -> tuple[str, str] | None:
    """Whose environment, a key of :data:`ENVIRONMENTS`, and which; None for other names."""
    whose, _, environment = name.partition(":")
    return (whose, environment) if whose in ENVIRONMENTS and environment else None


def is_made(name: str) -> bool:
    """Whether a task's ``name`` stands for a model or an environment, of which a task is made."""
    return split_model(name) is not None or split_environment(name) is not None


def class_name(name: str) -> str:
    """The last part of a name, for titles and folders: a registered name, the ClassName, a model's stem and point."""
    if model := split_model(name):
        name = ".".join(filter(None, (Path(model[0]).stem, *model[1:])))
        return re.sub(r"[^\w.-]", "-", name)
    return name.rpartition(":")[2].replace("/", "-")


def resolve_name(field: str, name: str) -> str:
    """What a field of :data:`REGISTERED` says as a run stores it: with an absolute path, which holds everywhere.

    Raises:
        ConfigError: an unknown name, no such file or module, a file that is no Python, or one without such a class.
    """
    if field == "task" and is_made(name):
        return _resolve_made(name)
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


def _resolve_made(name: str) -> str:
    """A model or an environment, if its file or its package is there."""
    if environment := split_environment(name):
        module, install = ENVIRONMENTS[environment[0]]
        if find_spec(module) is None:
            raise ConfigError(f"task={name}: {module} is not installed: {install}")
        return name
    where = (split_model(name) or ("",))[0]
    path = Path(os.path.expanduser(where)).resolve()
    if not path.is_file():
        raise ConfigError(f"task={name}: {'no such file' if not path.exists() else 'is no file'}: {path}")
    try:
        root = ElementTree.parse(path).getroot().tag
    except (ElementTree.ParseError, OSError) as error:
        raise ConfigError(f"task={name}: {path} cannot be read: {one_line(error)}") from None
    if root != "mujoco":
        raise ConfigError(f"task={name}: {path} is no MJCF: its root is <{root}>, must be <mujoco>")
    return str(path) + name[len(where) :]


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
        instead = "for a file write path/to/file.py:ClassName"
        if setting.startswith("task="):
            instead += ", for an environment gymnasium:ENV_ID or playground:ENV"
        raise ConfigError(f"{setting}: no module {module} in Python's path; {instead}")
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
