"""The picture of a scaling sweep: speed with the ideal line, time and memory per environment step.

python -m experiments.scaling_plot                      # draws experiments/results/scaling.csv again
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from experiments import style
from experiments.report import RESULTS, options, read
from rcg_jax.config import option

#: One colour for each line, from Okabe and Ito's palette.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C510A", "#56B4E9", "#E69F00")


@dataclass(frozen=True)
class PlotOptions:
    """Settings of ``python -m experiments.scaling_plot``."""

    out: str = option(str(RESULTS / "scaling.csv"), "CSV file; the picture lies beside it")
    device: str = option("all", "only rows of this device")


Row = Mapping[str, str]


def series(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of each line, by its label; a line varies in the environments only, which grow along it."""
    settings = ("task", "engine", "num_seeds", "devices", "length", "trpo_iterations", "device", "commit")
    varying = [key for key in settings if len({row[key] for row in rows}) > 1]
    words = {"num_seeds": "{} seeds", "devices": "{} devices", "length": "{} steps", "trpo_iterations": "{} TRPO its."}
    lines: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: int(row["num_envs"])):
        parts = [words.get(key, "{}").format(style.title(row[key])) for key in dict.fromkeys(("engine", *varying))]
        lines.setdefault(", ".join(parts), []).append(row)
    return lines


def total(row: Row) -> int:
    """Environments of all seeds."""
    return int(row["num_envs"]) * int(row["num_seeds"])


def memory_gb(row: Row) -> float:
    """What training takes: of an accelerator its peak, of a CPU what the compiler planned."""
    return float(row["device_gb"] or row["planned_gb"])


def _speed(axes: Axes, lines: Mapping[str, Sequence[Row]]) -> None:
    for (label, rows), colour in zip(lines.items(), COLOURS * len(lines), strict=False):
        good = [row for row in rows if row["status"] == "ok"]
        if good:
            x, y = [total(row) for row in good], [float(row["steps_per_s"]) for row in good]
            axes.plot(x, y, "o-", color=colour, label=label)
            ends = (x[0], max(total(row) for row in rows))
            axes.plot(ends, [y[0] * end / x[0] for end in ends], ls=":", color=colour, lw=1.2)
    axes.plot([], [], ls=":", color="0.4", lw=1.2, label="ideal: in proportion to the environments")
    bottom = axes.get_ylim()[0]
    for (_, rows), colour in zip(lines.items(), COLOURS * len(lines), strict=False):
        for row in (row for row in rows if row["status"] != "ok"):
            axes.plot(total(row), bottom, "x", color=colour, ms=8, mew=2, clip_on=False)
            axes.annotate(
                row["status"],
                (total(row), bottom),
                rotation=90,
                fontsize=7.5,
                xytext=(0, 8),
                ha="center",
                textcoords="offset points",
            )
    axes.set(title="Training speed", ylabel="environment steps / s", xscale="log", yscale="log")
    if any(axes.get_legend_handles_labels()):
        axes.legend(loc="upper left")


def _per_step(axes: Axes, lines: Mapping[str, Sequence[Row]], name: str) -> None:
    for (_, rows), colour in zip(lines.items(), COLOURS * len(lines), strict=False):
        good = [row for row in rows if row["status"] == "ok"]
        if name == "time":
            y = [1e6 * float(row["cpu_s"]) / float(row["env_steps"]) for row in good]
        else:
            y = [2**20 * memory_gb(row) / total(row) for row in good]
        axes.plot([total(row) for row in good], y, "o-", color=colour)
    axes.set(xscale="log", yscale="log")
    if name == "time":
        axes.set(title="Processor time of a step", ylabel="microseconds, all threads")
    else:
        axes.set(title="Memory of an environment", ylabel="KiB: arguments, results, temporaries")


def draw(path: Path, device: str = "all") -> Path:
    """Draws the rows of ``device``, or all, of the CSV file ``path``; returns the picture's path, beside it.

    Raises:
        ValueError: it has none.
    """
    rows = [row for row in read(path) if device in ("all", row["device"])]
    if not rows:
        raise ValueError(f"{path} has no rows of {device}")
    style.use()
    lines = series(rows)
    figure, panels = plt.subplots(1, 3, figsize=(style.WIDTH * 1.3, 4.6), layout="constrained", width_ratios=(3, 2, 2))
    _speed(panels[0], lines)
    _per_step(panels[1], lines, "time")
    _per_step(panels[2], lines, "memory")
    for axes in panels:
        axes.set_xlabel("environments x seeds")
    devices, commits = sorted({row["device"] for row in rows}), sorted({row["commit"] for row in rows})
    load = max((float(row["load"]) for row in rows if row["load"]), default=0.0)
    cpus = rows[0]["cpus"]
    style.note(
        figure,
        [
            f"{', '.join(devices)}, {cpus} CPU cores, commit {', '.join(commits)}; tasks "
            f"{', '.join(dict.fromkeys(style.title(row['task']) for row in rows))}. A train step pays for physics, "
            f"policy, walks, TRPO and baseline. Load of the machine before a point: up to {load:g}.",
        ],
    )
    return style.save(figure, path.with_suffix(".png"))


def main() -> None:
    """Draws."""
    chosen = options(PlotOptions, "experiments.scaling_plot")
    try:
        print(draw(Path(chosen.out), chosen.device))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
