"""Classes of one's own: what is behind ``task=path/to/file.py:ClassName`` or ``method=package.module:ClassName``."""

from __future__ import annotations

import hashlib
import importlib
import sys
import traceback
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from rcg_jax.config.class_path import is_file_form, resolve_name
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.console import one_line


def load_class(field: str, name: str) -> type:
    """Imports the class that ``task=`` or ``method=`` names. The same file is imported once per process.

    The file's folder is appended to Python's path, so that it can import what lies beside it.

    Raises:
        ConfigError: one line: no such file, module or class, or the import failed (where and why).
    """
    where, _, cls = resolve_name(field, name).rpartition(":")
    try:
        module = _import_file(Path(where)) if is_file_form(where) else importlib.import_module(where)
    except (Exception, SystemExit) as error:
        line = line_in(error, Path(where))
        at = f", line {line}" if line else ""
        raise ConfigError(f"{field}={name}: importing {where} failed{at}: {describe(error)}") from error
    found = getattr(module, cls, None)
    if not isinstance(found, type):
        what = "no such class" if found is None else f"{cls} is no class"
        raise ConfigError(f"{field}={name}: {what} in {where}")
    if hasattr(found, "rename"):  # made by a function, which does not know the variable
        found.rename(cls)
    return found


def _import_file(path: Path) -> ModuleType:
    """The module of a file, under a name that no other file shares."""
    name = f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def describe(error: BaseException) -> str:
    """An exception in one line of bearable length."""
    text = one_line(error)
    kind = type(error).__name__
    if text == kind:  # it says nothing
        return kind
    return f"{kind}: {text if len(text) <= 240 else text[:237] + '...'}"


def line_in(error: BaseException, path: Path | None) -> int | None:
    """The innermost line of ``path`` that an exception passed through."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) == path]
    return lines[-1] if lines else None
