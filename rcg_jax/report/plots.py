"""Pictures of a run: how success grew, and where the starts of the last iteration are. The end of a run draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from rcg_jax.config.class_path import class_name
from rcg_jax.curriculum.select import difficulty
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.io.tables import read_columns
from rcg_jax.physics.jit import jit
from rcg_jax.runs.checkpoint import iterations
from rcg_jax.runs.load import LoadedRun, load_run
from rcg_jax.runs.settings import read_config
from rcg_jax.tasks.base import Task
from rcg_jax.types import Snapshot, StartSet

#: Okabe and Ito's colours, distinct for the colour-blind.
BLUE, ORANGE, GREEN, VERMILLION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#999999"

#: Kinds of starts: attribute of Difficulty, label, colour.
KINDS = (("high", "mastered", GREEN), ("good", "good", BLUE), ("low", "too hard", VERMILLION))

#: Feasible starts that stand for all of them in a picture.
_REFERENCE = 5_000

_DPI = 130


def write_run_pictures(run_dir: Path) -> list[Path]:
    """Draws ``learning_curve.png`` and ``starts.png`` into a run's folder.

    Args:
        run_dir: a seed's folder ``<run_dir>/<task>/<method>/seed<k>``.

    Returns:
        The files written: what the run has no data for yet is left out.

    Raises:
        ConfigError: no run there, or one that cannot be loaded.
        OSError: a picture cannot be written.
    """
    config = read_config(run_dir)
    title = f"{class_name(config.task)}, {config.method}, seed {config.seed}"
    written = []
    metrics = read_columns(run_dir / "metrics.csv")
    if metrics:
        written.append(
            _save(learning_curve(metrics, read_columns(run_dir / "eval.csv"), title), run_dir, "learning_curve")
        )
    if iterations(run_dir / "checkpoints"):
        written.append(_save(starts_picture(load_run(run_dir), title), run_dir, "starts"))
    return written


def _save(figure: Figure, folder: Path, name: str) -> Path:
    path, partial = folder / f"{name}.png", folder / f".{name}.new.png"
    try:
        figure.savefig(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)


def learning_curve(metrics: dict[str, np.ndarray], evaluations: dict[str, np.ndarray], title: str) -> Figure:
    """Success, difficulty and distance of the starts over environment steps.

    Args:
        metrics: columns of metrics.csv.
        evaluations: columns of eval.csv; may be empty.
        title: what was trained.
    """
    figure = Figure(figsize=(7.5, 7.5), dpi=_DPI, layout="constrained")
    success, shares, distance = figure.subplots(3, 1, sharex=True, height_ratios=[2.4, 1, 1])
    steps = metrics["env_steps"] / 1e6
    success.plot(steps, metrics["success"], color=GREY, linewidth=1.3, label=r"on $\rho_i$ (training starts)")
    if evaluations:
        at = evaluations["env_steps"] / 1e6
        for name, label, colour, marker in (("mean", "mean", ORANGE, "s"), ("stochastic", "stochastic", BLUE, "o")):
            key = f"success_{name}"
            success.fill_between(
                at, evaluations[f"{key}_low"], evaluations[f"{key}_high"], color=colour, alpha=0.18, lw=0
            )
            success.plot(
                at, evaluations[key], color=colour, marker=marker, markersize=4, label=rf"on $\rho_0$, {label} policy"
            )
    success.set(ylabel="success", ylim=(-0.02, 1.02), title=title)
    handles, labels = success.get_legend_handles_labels()
    success.legend(
        handles[::-1], labels[::-1], frameon=False, loc="best", title="shaded: 95 % interval", alignment="left"
    )
    shares.stackplot(
        steps,
        [metrics[f"share_{kind}"] for kind, _, _ in KINDS],
        colors=[colour for _, _, colour in KINDS],
        labels=[label for _, label, _ in KINDS],
        alpha=0.85,
        linewidth=0,
    )
    shares.set(ylabel="share of starts", ylim=(0, 1))
    shares.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=len(KINDS), borderaxespad=0)
    distance.plot(steps, metrics["start_distance"], color="0.2")
    distance.set(ylabel="mean distance of\nstarts to goal [m]", xlabel="environment steps [million]")
    distance.set_ylim(bottom=0)
    distance.set_xlim(0, 1.02 * steps[-1])
    for axes in (success, shares, distance):
        _tidy(axes)
    figure.align_ylabels()
    return figure


def starts_picture(run: LoadedRun, title: str) -> Figure:
    """Where the starts of the last rho_i are: distances to the goal and, where the task has a point, a plan view."""
    task, starts = run.task, jax.device_get(run.state.starts)
    kinds = _kinds(run, starts)
    snapshot, distance = _look(task, starts)
    point = goal_point(task, snapshot, distance)
    figure = Figure(figsize=(10 if point else 6, 4.6), dpi=_DPI, layout="constrained")
    columns = figure.subplots(1, 2 if point else 1, squeeze=False)[0]
    histogram = columns[0]
    reference = _feasible_distance(task)
    far = max(distance[starts.valid].max(initial=0.0), reference.max(initial=0.0), 1e-3)
    edges = np.linspace(0, far, 31)
    histogram.hist(
        [distance[mask] for _, _, mask in kinds],
        bins=edges,
        stacked=True,
        color=[colour for _, colour, _ in kinds],
        label=[f"{label} ({mask.sum()})" for label, _, mask in kinds],
    )
    if reference.size:
        weight = np.full(reference.size, starts.valid.sum() / reference.size)
        label = r"$\rho_0$, scaled"
        histogram.hist(reference, bins=edges, weights=weight, histtype="step", color="0.25", linewidth=1.3, label=label)
    histogram.set(xlabel="distance to goal [m]", ylabel="starts", xlim=(0, far))
    histogram.legend(frameon=False, reverse=True)
    _tidy(histogram)
    if point:
        _plan(columns[1], point, kinds)
    figure.suptitle(f"{title}: starts of iteration {run.iteration}")
    return figure


def _kinds(run: LoadedRun, starts: StartSet) -> list[tuple[str, str, np.ndarray]]:
    """(label, colour, mask (C,)) of the kinds of starts that there are."""
    cfg = run.config.curriculum
    found = difficulty(starts, run.state.labels, r_min=cfg.r_min, r_max=cfg.r_max, min_episodes=cfg.min_episodes)
    kinds = [(label, colour, np.asarray(getattr(found, name))) for name, label, colour in KINDS]
    unlabelled = np.asarray(starts.valid) & ~np.any([mask for _, _, mask in kinds], axis=0)
    return [kind for kind in [*kinds, ("too few episodes", GREY, unlabelled)] if kind[2].any()]


def _look(task: Task, starts: StartSet) -> tuple[Snapshot, np.ndarray]:
    """Kinematics of C starts, and their distances to the goal (C,) [m]."""

    def look(starts: StartSet) -> tuple[Snapshot, jax.Array]:
        snapshot = task.snapshot(task.reset(starts))
        return snapshot, jax.vmap(task.distance)(snapshot)

    snapshot, distance = jax.device_get(jit(look)(starts))
    return snapshot, np.asarray(distance)


def _feasible_distance(task: Task) -> np.ndarray:
    """Distances of some feasible starts [m]; none where the task has no set of them."""
    try:
        feasible = task.feasible_starts()
    except (FileNotFoundError, StartsFileError):
        return np.zeros(0)
    # Evenly through the file, so that the picture is the same every time.
    rows = np.unique(np.linspace(0, feasible.capacity - 1, min(_REFERENCE, feasible.capacity)).astype(int))
    return _look(task, feasible.take(jnp.asarray(rows)))[1]


@dataclass(frozen=True)
class GoalPoint:
    """The point of a task that has to come to its goal.

    Attributes:
        name: its name in the model.
        position: (C, 3) where it is in each state [m].
        goal: (3,) where it has to be [m].
    """

    name: str
    position: np.ndarray
    goal: np.ndarray


def goal_point(task: Task, snapshot: Snapshot, distance: np.ndarray) -> GoalPoint | None:
    """Finds the site or body whose distance to the model's site ``goal`` is the task's distance in all C states.

    Tasks need not name it. None where there is no such site, or no such point: a task may measure something else.
    """
    model = task.model
    names = [model.site(i).name for i in range(model.nsite)]
    if "goal" not in names:
        return None
    goal = np.asarray(snapshot.site_xpos)[:, names.index("goal")]
    points = [(name, np.asarray(snapshot.site_xpos)[:, i]) for i, name in enumerate(names)]
    points += [(model.body(i).name, np.asarray(snapshot.xpos)[:, i]) for i in range(1, model.nbody)]
    for name, position in points:
        if np.allclose(np.linalg.norm(position - goal, axis=1), distance, atol=1e-4):
            return GoalPoint(name=name, position=position, goal=goal[0])
    return None


def _plan(axes: Axes, point: GoalPoint, kinds: Sequence[tuple[str, str, np.ndarray]]) -> None:
    """Seen from above. The goal lies at the origin; circles show the scale."""
    offset = (point.position - point.goal)[:, :2]
    shown = np.any([mask for _, _, mask in kinds], axis=0)
    reach = max(float(np.abs(offset[shown]).max(initial=0.0)) * 1.1, 0.02)
    spacing = 0.1 if reach > 0.15 else 0.02
    for radius in np.arange(spacing, reach * 1.5, spacing):
        axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor="0.88", linewidth=0.8))
    # The rare kinds on top.
    for _, colour, mask in sorted(kinds, key=lambda kind: -int(kind[2].sum())):
        axes.scatter(offset[mask, 0], offset[mask, 1], s=14, color=colour, alpha=0.75, linewidth=0)
    axes.scatter(0, 0, marker="+", s=120, color="black", linewidth=1.6)
    axes.annotate("goal", (0, 0), xytext=(6, 6), textcoords="offset points")
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.locator_params(nbins=5)
    axes.set(xlabel="x from goal [m]", ylabel="y from goal [m]", title=f"{point.name}, seen from above")
    axes.spines[["top", "right"]].set_visible(False)
