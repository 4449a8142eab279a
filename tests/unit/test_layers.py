"""Imports go one way: a room of the package imports only from itself and from the rooms above it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import rcg_jax

PACKAGE = Path(rcg_jax.__file__).parent

#: From the top to the bottom; also the order in which to read.
LAYERS = (
    *("types", "io", "config", "sharding", "physics", "tasks", "rl", "curriculum", "methods", "train_step"),
    *("gymnasium", "brax", "evaluate", "policies", "runs", "report"),
    *("cli", "interactive"),
)
COMMANDS = ("__main__", "run", "render", "export", "feasible")


def imports() -> Iterator[tuple[str, str, str]]:
    """(file, its room, room that it imports from), also of imports inside functions."""
    for path in sorted(PACKAGE.rglob("*.py")):
        inside = path.relative_to(PACKAGE).with_suffix("").parts
        room = inside[-1] if inside[-1] == "__main__" else inside[0]  # a room's __main__ is a command
        for node in ast.walk(ast.parse(path.read_text())):
            modules = []
            if isinstance(node, ast.ImportFrom) and node.module == "rcg_jax":
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rcg_jax."):
                modules = [str(node.module).split(".")[1]]
            elif isinstance(node, ast.Import):
                modules = [alias.name.split(".")[1] for alias in node.names if alias.name.startswith("rcg_jax.")]
            for module in modules:
                yield str(path.relative_to(PACKAGE)), room, module


def test_every_room_has_a_place() -> None:
    rooms = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert rooms - {"__init__"} == {*LAYERS, *COMMANDS}


def test_imports_go_down() -> None:
    place = {room: i for i, room in enumerate((*LAYERS, *COMMANDS))}
    upward = [
        f"{file} imports {module}"
        for file, room, module in imports()
        if room in place and module in place and module != room and place[module] > place[room]
    ]
    assert not upward
    crossing = [f"{file} imports {module}" for file, room, module in imports() if module in COMMANDS and room != module]
    assert not crossing
