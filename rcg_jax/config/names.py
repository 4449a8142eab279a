"""Names that a run can be asked for, importable without JAX so that wrong ones are refused at once.

The registries that build the named things (tasks, methods, engines) have exactly these keys.
"""

import difflib
from collections.abc import Iterable

TASKS: tuple[str, ...] = ("point_maze", "ant_maze", "ring_peg", "key_insertion")
METHODS: tuple[str, ...] = ("reverse", "all_starts", "uniform", "oracle", "self_play")
#: Loggers beside CSV files and TensorBoard: none, or a class of one's own.
LOGGERS: tuple[str, ...] = ("none",)
ENGINES: tuple[str, ...] = ("mjx", "native", "warp")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``did you mean ...?`` with the nearest of the known names; empty where none is near."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]}?" if near else ""
