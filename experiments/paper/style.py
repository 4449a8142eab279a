"""How all figures look: a colour and a name for each method, and what every picture says about its data."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

#: Label and colour of each method, in the order of legends: the hues of the paper's figures, from Okabe and Ito's
#: palette, which the colour-blind can tell apart.
METHODS = {
    "reverse": ("reverse curriculum (good starts)", "#009E73"),
    "all_starts": ("Brownian from all starts", "#0072B2"),
    "uniform": ("uniform starts", "#D55E00"),
    "oracle": ("oracle (rejection sampling)", "#8C510A"),
    "self_play": ("asymmetric self-play", "#CC79A7"),
}

#: What tasks are called in titles.
TASKS = {
    "point_maze": "Point-mass maze",
    "ant_maze": "Ant maze",
    "ring_peg": "Ring on peg",
    "key_insertion": "Key insertion",
}

#: Width of a figure [inches], and its resolution.
WIDTH, DPI = 10.0, 130

_GREY = "#777777"

_SETTINGS: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.labelcolor": "0.2",
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.92",
    "grid.linewidth": 0.8,
    "xtick.color": "0.3",
    "ytick.color": "0.3",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.solid_capstyle": "round",
}


def use() -> None:
    """Sets Matplotlib's defaults; every figure is drawn with these."""
    mpl.rcParams.update(_SETTINGS)


def label(method: str) -> str:
    """What a method is called; one of the user's own by its name."""
    return METHODS.get(method, (method, _GREY))[0]


def colour(method: str) -> str:
    """The colour of a method in all figures."""
    return METHODS.get(method, (method, _GREY))[1]


def title(task: str) -> str:
    """What a task is called."""
    return TASKS.get(task, task)


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods as in legends."""
    known = list(METHODS)
    return sorted(set(methods), key=lambda name: (known.index(name) if name in known else len(known), name))


def empty(axes: Axes, text: str) -> None:
    """A panel without data says what makes them."""
    # Not its ticks: other panels may share them.
    axes.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
    axes.grid(visible=False)
    axes.set(xlabel="", ylabel="")
    axes.spines[:].set_visible(False)
    axes.text(
        0.5, 0.5, textwrap.fill(text, 44), transform=axes.transAxes, ha="center", va="center", color=_GREY, fontsize=9
    )


def over_steps(axes: Axes, task: str, counts: Mapping[str, int], absent: Sequence[str] = (), width: int = 66) -> None:
    """A panel of success, or a share, over environment steps; below it the seeds of each line, and what there is not.

    Args:
        axes: the panel.
        task: its title.
        counts: number of seeds of each of its lines, by a short name.
        absent: short names of lines that nobody has run yet.
        width: of the lines below it [characters].
    """
    axes.set(title=title(task), ylim=(0, 1.02), xlim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=axes.get_xlim()[1] > 5))
    parts = ["seeds: " + ", ".join(f"{name} {count}" for name, count in counts.items())] if counts else []
    parts += ["not run yet: " + ", ".join(absent)] if absent else []
    lines = [line for part in parts for line in textwrap.wrap(part, width)]
    axes.set_xlabel("\n".join(["environment steps [million]", *lines]), fontsize=8.5)


def legend(figure: Figure, lines: Sequence[tuple[str, str, str]]) -> None:
    """One legend of all panels, above them.

    Args:
        figure: with a constrained layout.
        lines: (label, colour, line style).
    """
    handles = [Line2D([], [], color=colour, ls=line, lw=2.2, label=label) for label, colour, line in lines]
    figure.legend(handles=handles, loc="outside upper left", ncols=min(len(handles), 5), columnspacing=1.6)


def note(figure: Figure, sentences: Sequence[str]) -> None:
    """Small print below the panels: what the lines are and where the numbers come from."""
    width = int(figure.get_figwidth() * 17.3)
    lines = [line for sentence in sentences for line in textwrap.wrap(sentence, width)]
    size = figure.get_figheight()
    room = 0.145 * len(lines) + 0.08
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0, room / size, 1, 1 - room / size))
    figure.text(0.012, 0.05 / size, "\n".join(lines), fontsize=7.5, color=_GREY, va="bottom", linespacing=1.3)


def save(figure: Figure, path: Path) -> Path:
    """Writes a PNG; the file is replaced only when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.new.png")
    # No date and no version inside, so that the same data give the same file.
    figure.savefig(partial, dpi=DPI, facecolor="white", metadata={"Software": None})
    partial.replace(path)
    return path
