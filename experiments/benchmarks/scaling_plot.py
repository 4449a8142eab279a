"""The picture of a scaling sweep: speed with the ideal line, time and memory per environment step.

python -m experiments.benchmarks.scaling_plot                      # draws experiments/results/scaling.csv again
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from experiments.common import RESULTS, options, read
from experiments.paper import style
from rcg_jax.config.class_path import class_name
from rcg_jax.config.settings import option

#: One colour for each line, from Okabe and Ito's palette.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C510A", "#56B4E9", "#E69F00")


@dataclass(frozen=True)
class PlotOptions:
    """Settings of ``python -m experiments.benchmarks.scaling_plot``."""

    out: str = option(str(RESULTS / "scaling.csv"), "CSV file; the picture lies beside it")
    device: str = option("all", "only rows of this device")


Row = Mapping[str, str]


def _title(value: str) -> str:
    """What a task is called; other values as they are."""
    return style.title(class_name(value))


def series(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of each line, by its label; a line varies in the environments only, which grow along it."""
    settings = ("task", "engine", "num_seeds", "devices", "length", "trpo_iterations", "device", "commit")
    varying = [key for key in settings if len({row[key] for row in rows}) > 1]
    words = {"num_seeds": "{} seeds", "devices": "{} devices", "length": "{} steps", "trpo_iterations": "{} TRPO its."}
    lines: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: int(row["num_envs"])):
        parts = [
            words.get(key, "{}").format(style.title(class_name(row[key])))
            for key in dict.fromkeys(("engine", *varying))
        ]
        lines.setdefault(", ".join(parts), []).append(row)
    return lines


def total(row: Row) -> int:
    """Environments of all seeds."""
    return int(row["num_envs"]) * int(row["num_seeds"])


def memory_gb(row: Row) -> float:
    """What training takes: of an accelerator its peak, of a CPU what the compiler planned."""
    return float(row["device_gb"] or row["planned_gb"])


def _coloured(lines: Mapping[str, Sequence[Row]]) -> list[tuple[str, Sequence[Row], str]]:
    """(label, rows, colour) of each line."""
    return [(label, rows, COLOURS[k % len(COLOURS)]) for k, (label, rows) in enumerate(lines.items())]


def _good(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["status"] == "ok"]


def _number(value: float, _: object = None) -> str:
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}"


def _speed(axes: Axes, lines: Mapping[str, Sequence[Row]]) -> None:
    axes.set(title="Training speed", ylabel="environment steps / s", xscale="log", yscale="log")
    for label, rows, colour in _coloured(lines):
        if good := _good(rows):
            x, y = [total(row) for row in good], [float(row["steps_per_s"]) for row in good]
            axes.plot(x, y, "o-", color=colour, label=label)
            ends = (x[0], max(total(row) for row in rows))
            axes.plot(ends, [y[0] * end / x[0] for end in ends], ls=":", color=colour, lw=1.2)
    axes.plot([], [], ls=":", color="0.4", lw=1.2, label="ideal: in proportion to the environments")
    bottom = axes.get_ylim()[0]
    for _, rows, colour in _coloured(lines):
        for row in (row for row in rows if row["status"] != "ok"):
            axes.plot(total(row), bottom, "x", color=colour, ms=8, mew=2, clip_on=False)
            place: dict[str, Any] = {"xytext": (0, 8), "textcoords": "offset points", "ha": "center", "va": "bottom"}
            axes.annotate(row["status"], (total(row), bottom), rotation=90, fontsize=7.5, **place)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(_number)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="upper left")


def _time_us(row: Row) -> float:
    """Of a CPU its processor time for an environment step, of an accelerator the wall clock [microseconds]."""
    return 1e6 * float(row["iteration_s"] if row["device_gb"] else row["cpu_s"]) / float(row["env_steps"])


def _flat(axes: Axes, lines: Mapping[str, Sequence[Row]], quantity: Callable[[Row], float]) -> None:
    top = 0.0
    for _, rows, colour in _coloured(lines):
        good = _good(rows)
        y = [quantity(row) for row in good]
        axes.plot([total(row) for row in good], y, "o-", color=colour)
        top = max([top, *y])
    axes.set(xscale="log", ylim=(0, 1.15 * top or None))


def _devices(axes: Axes, rows: Sequence[Row]) -> None:
    """Speed over devices at the largest number of environments that all of them did."""
    axes.set(title="Speed over devices", xlabel="devices", ylabel="environment steps / s", xscale="log", yscale="log")
    fixed = ("task", "engine", "num_seeds", "length", "trpo_iterations", "commit", "num_envs")
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in sorted(_good(rows), key=lambda row: int(row["devices"])):
        groups.setdefault(tuple(row[key] for key in fixed), []).append(row)
    for k, (key, found) in enumerate((key, found) for key, found in groups.items() if len(found) > 1):
        x, y = [int(row["devices"]) for row in found], [float(row["steps_per_s"]) for row in found]
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(x, y, "o-", color=colour, label=f"{key[1]}, {int(key[-1]):,} environments")
        axes.plot((x[0], x[-1]), (y[0], y[0] * x[-1] / x[0]), ls=":", color=colour, lw=1.2)
    axes.set_xticks(sorted({int(row["devices"]) for row in rows}))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(_number)
        axis.set_minor_formatter(NullFormatter())
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left")


def draw(path: Path, device: str = "all") -> Path:
    """Draws the rows of ``device``, or all, of the CSV file ``path``; returns the picture's path, beside it.

    Raises:
        ValueError: it has none, or none of a point that worked.
    """
    rows = [row for row in read(path) if device in ("all", row["device"])]
    if not rows:
        raise ValueError(f"{path} has no rows of {device}")
    if not _good(rows):
        raise ValueError(f"{path} has no point that worked; nothing to draw")
    style.use()
    lines = series(rows)
    names = ", ".join(dict.fromkeys(_title(row["task"]) for row in rows))
    several = len({row["devices"] for row in rows}) > 1
    widths = (3, 2, 2, 2)[: 3 + several]
    figure, panels = plt.subplots(
        1, len(widths), figsize=(1.8 * sum(widths), 4.6), layout="constrained", width_ratios=widths
    )
    _speed(panels[0], lines)
    accelerated = any(row["device_gb"] for row in rows)
    _flat(panels[1], lines, _time_us)
    panels[1].set(
        title="Time of an environment step", ylabel=f"{'wall clock' if accelerated else 'processor time'} [us]"
    )
    _flat(panels[2], lines, lambda row: 2**20 * memory_gb(row) / total(row))
    panels[2].set(title="Memory of an environment", ylabel="arguments, results, temporaries [KiB]")
    ticks = sorted({total(row) for row in rows})
    for axes in panels[:3]:
        axes.set_xlabel("environments x seeds")
        axes.set_xticks(ticks[:: -(-len(ticks) // 6)])
        axes.xaxis.set_major_formatter(_number)
        axes.xaxis.set_minor_locator(NullLocator())
    if several:
        _devices(panels[3], rows)
    devices, commits = sorted({row["device"] for row in rows}), sorted({row["commit"] for row in rows})
    load = max((float(row["load"]) for row in rows if row["load"]), default=0.0)
    cpus = rows[0]["cpus"]
    style.note(
        figure,
        [
            f"{', '.join(devices)}, {cpus} CPU cores, commit {', '.join(commits)}; tasks {names}. A train step pays "
            f"for physics, policy, walks, TRPO and baseline. Load of the machine before a point: up to {load:g}.",
        ],
    )
    return style.save(figure, path.with_suffix(".png"))


def main() -> None:
    """Draws."""
    chosen = options(PlotOptions, "experiments.benchmarks.scaling_plot")
    try:
        print(draw(Path(chosen.out), chosen.device))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
