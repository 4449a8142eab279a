"""Names that a run can be asked for, importable without JAX so that wrong ones are refused at once.

The registries that build the named things (tasks, methods, engines) have exactly these keys.
"""

TASKS: tuple[str, ...] = ("point_maze", "ant_maze", "ring_peg", "key_insertion")
METHODS: tuple[str, ...] = ("reverse", "all_starts", "uniform", "oracle", "self_play")
ENGINES: tuple[str, ...] = ("mjx", "native", "warp")
