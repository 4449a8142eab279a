"""``rcg COMMAND ...``, or ``python -m rcg_jax COMMAND ...``: the commands of this package by their names."""

from __future__ import annotations

import importlib
import sys

#: Command -> (module whose ``main`` it is, what it does).
COMMANDS = {
    "run": ("rcg_jax.run", "trains, or continues, a run; sweeps with -m"),
    "evaluate": ("rcg_jax.evaluate.__main__", "success of a run or policy on rho_0, by region"),
    "render": ("rcg_jax.render", "an mp4 of a run or policy at work"),
    "report": ("rcg_jax.report.__main__", "report.html of a run, or a comparison of several"),
    "export": ("rcg_jax.export", "the policy of a run as a file, or the model of a task"),
    "policies": ("rcg_jax.policies.__main__", "the trained policies that come with this package"),
    "feasible": ("rcg_jax.feasible", "generates the feasible starts of a task"),
}


def main() -> int:
    """The command line; returns the exit code."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in COMMANDS:
        sys.argv = [f"{sys.argv[0]} {name}", *sys.argv[2:]]
        return int(importlib.import_module(COMMANDS[name][0]).main())
    if name in ("--version", "-V"):
        from rcg_jax import __version__

        print(f"rcg_jax {__version__}")
        return 0
    asked = name in ("--help", "-h")
    stream = sys.stdout if asked else sys.stderr
    if not asked:
        print(f"error: {name}: no such command", file=stream)
    print("usage: rcg COMMAND [name=value ...]; rcg COMMAND --help\n", file=stream)
    for command, (_, what) in COMMANDS.items():
        print(f"  {command:<10} {what}", file=stream)
    return 0 if asked else 2


if __name__ == "__main__":
    sys.exit(main())
