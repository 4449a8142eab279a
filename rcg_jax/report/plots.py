"""Pictures of a run: how success grew, and where the starts of the last iteration are. The end of a run draws them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from rcg_jax.config.class_path import class_name
from rcg_jax.io.tables import read_columns, write_atomically
from rcg_jax.report.growth import kinds
from rcg_jax.report.points import Locator, evenly, feasible_states
from rcg_jax.runs.checkpoint import iterations
from rcg_jax.runs.load import LoadedRun, load_run
from rcg_jax.runs.settings import read_config

#: Okabe and Ito's colours, distinct for the colour-blind.
BLUE, ORANGE, GREEN, VERMILLION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#999999"

#: Kinds of starts, by the number that :func:`rcg_jax.report.growth.kinds` gives them: column, label, colour.
KINDS = {
    2: ("share_high", "mastered", GREEN),
    1: ("share_good", "good", BLUE),
    0: ("share_low", "too hard", VERMILLION),
    3: ("", "too few episodes", GREY),
}

#: Feasible starts that stand for all of them in a picture.
_REFERENCE = 5_000

_DPI = 130


def write_run_pictures(run_dir: Path) -> list[Path]:
    """Draws ``learning_curve.png`` and ``starts.png`` into a seed's folder; returns those that the run has data for.

    Raises:
        ConfigError: no run there, or one that cannot be loaded.
        OSError: a picture cannot be written.
    """
    config = read_config(run_dir)
    title = f"{class_name(config.task)}, {config.method}, seed {config.seed}"
    metrics = read_columns(run_dir / "metrics.csv")
    written = []
    if metrics:
        figure = learning_curve(metrics, read_columns(run_dir / "eval.csv"), title)
        written.append(_save(figure, run_dir / "learning_curve.png"))
    if iterations(run_dir / "checkpoints"):
        written.append(_save(starts_picture(load_run(run_dir), title), run_dir / "starts.png"))
    return written


def _save(figure: Figure, path: Path) -> Path:
    picture = io.BytesIO()
    figure.savefig(picture)
    write_atomically(path, picture.getvalue())
    return path


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)


def learning_curve(metrics: dict[str, np.ndarray], evaluations: dict[str, np.ndarray], title: str) -> Figure:
    """Success, difficulty and distance of the starts over environment steps.

    From the columns of metrics.csv and eval.csv; the latter may have none.
    """
    figure = Figure(figsize=(7.5, 7.5), dpi=_DPI, layout="constrained")
    success, shares, distance = figure.subplots(3, 1, sharex=True, height_ratios=[2.4, 1, 1])
    steps = metrics["env_steps"] / 1e6
    success.plot(steps, metrics["success"], color=GREY, linewidth=1.3, label=r"on $\rho_i$ (training starts)")
    if evaluations:
        at = evaluations["env_steps"] / 1e6
        for name, colour, marker in (("mean", ORANGE, "s"), ("stochastic", BLUE, "o")):
            rate, low, high = (evaluations[f"success_{name}{end}"] for end in ("", "_low", "_high"))
            success.fill_between(at, low, high, color=colour, alpha=0.18, lw=0)
            success.plot(at, rate, color=colour, marker=marker, markersize=4, label=rf"on $\rho_0$, {name} policy")
    success.set(ylabel="success", ylim=(-0.02, 1.02), title=title)
    handles, labels = (each[::-1] for each in success.get_legend_handles_labels())
    success.legend(handles, labels, frameon=False, loc="best", title="shaded: 95 % interval", alignment="left")
    columns, labels, colours = zip(*(kind for kind in KINDS.values() if kind[0]))
    shares.stackplot(steps, [metrics[name] for name in columns], colors=colours, labels=labels, alpha=0.85, linewidth=0)
    shares.set(ylabel="share of starts", ylim=(0, 1))
    shares.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=len(columns), borderaxespad=0)
    distance.plot(steps, metrics["start_distance"], color="0.2")
    distance.set(ylabel="mean distance of\nstarts to goal [m]", xlabel="environment steps [million]")
    distance.set_ylim(bottom=0)
    distance.set_xlim(0, 1.02 * steps[-1])
    for axes in (success, shares, distance):
        _tidy(axes)
    figure.align_ylabels()
    return figure


def starts_picture(run: LoadedRun, title: str) -> Figure:
    """Where the starts of the last rho_i are: their distances to the goal, and seen from above."""
    starts, labels = jax.device_get((run.state.starts, run.state.labels))
    feasible, _ = feasible_states(run.task)
    feasible = feasible[evenly(len(feasible), _REFERENCE)]
    locator = Locator(run.task, np.concatenate([feasible, starts.qpos[starts.valid]]))
    places, reference = locator(starts.qpos), locator(feasible).distance
    kind = np.where(starts.valid, kinds(labels, run.config.curriculum), -1)
    groups = [(label, colour, kind == k) for k, (_, label, colour) in KINDS.items() if np.any(kind == k)]

    figure = Figure(figsize=(10, 4.6), dpi=_DPI, layout="constrained")
    histogram, plan = figure.subplots(1, 2)
    far = max(places.distance[starts.valid].max(initial=0.0), reference.max(initial=0.0), 1e-3)
    edges = np.linspace(0, far, 31)
    histogram.hist(
        [places.distance[mask] for _, _, mask in groups],
        bins=edges,
        stacked=True,
        color=[colour for _, colour, _ in groups],
        label=[f"{label} ({mask.sum()})" for label, _, mask in groups],
    )
    if reference.size:
        weight = np.full(reference.size, starts.valid.sum() / reference.size)
        label = r"$\rho_0$, scaled"
        histogram.hist(reference, bins=edges, weights=weight, histtype="step", color="0.25", linewidth=1.3, label=label)
    histogram.set(xlabel="distance to goal [m]", ylabel="starts", xlim=(0, far))
    histogram.legend(frameon=False, reverse=True)
    _tidy(histogram)
    _draw_plan(plan, places.point - locator.goal, groups)
    plan.set_title(f"{locator.name}, seen from above" if locator.name else "seen from above")
    figure.suptitle(f"{title}: starts of iteration {run.iteration}")
    return figure


def _draw_plan(axes: Axes, offset: np.ndarray, groups: Sequence[tuple[str, str, np.ndarray]]) -> None:
    """Points at ``offset`` (C, 3) from the goal, seen from above; circles around the goal show the scale."""
    shown = np.any([mask for _, _, mask in groups], axis=0)
    reach = max(float(np.abs(offset[shown, :2]).max(initial=0.0)) * 1.1, 0.02)
    spacing = 0.1 if reach > 0.15 else 0.02
    for radius in np.arange(spacing, reach * 1.5, spacing):
        axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor="0.88", linewidth=0.8))
    # The rare kinds on top.
    for _, colour, mask in sorted(groups, key=lambda group: -int(group[2].sum())):
        axes.scatter(offset[mask, 0], offset[mask, 1], s=14, color=colour, alpha=0.75, linewidth=0)
    axes.scatter(0, 0, marker="+", s=120, color="black", linewidth=1.6)
    axes.annotate("goal", (0, 0), xytext=(6, 6), textcoords="offset points")
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x from goal [m]")
    axes.set_ylabel("y from goal [m]")
    axes.locator_params(nbins=5)
    axes.spines[["top", "right"]].set_visible(False)
