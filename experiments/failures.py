"""Where a policy fails: by distance, part of S^0, and the coordinates that tell failures best.

    python -m experiments.failures                             # all shipped policies
    python -m experiments.failures policy=ring_peg episodes=1000
    python -m experiments.failures run=runs/ring_peg/reverse/seed0

``failures.csv`` has the failures of the stochastic policy and of its mean action in each region of S^0, with their
share of all failures and of all starts. Regions are those of ``python -m rcg_jax.evaluate``, and ranges of coordinates:
the one or two whose quantile bins separate failures of the stochastic policy best (:mod:`experiments.separate`), bin by
bin (``coordinate``), and the range of them that holds most of the failures (``range``; the second among the starts
outside the first). ``failures_<policy>.png`` shows this, and four typical starts that failed, each in the middle of a
cluster of them. Rows of other policies stay; without a failure there is no picture.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments import style
from experiments.report import in_one_line, machine, options
from experiments.separate import Separation, as_words, coordinate_names, separate, typical
from experiments.trained import ACTIONS, Subject, fewer, folder, merge, play, starts, subjects
from rcg_jax.config.settings import option
from rcg_jax.evaluation.regions import make_regions
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.report.scene import RenderError, open_scene
from rcg_jax.report.scenery import outline, static_geoms
from rcg_jax.stats import wilson_interval
from rcg_jax.tasks import Task
from rcg_jax.tasks.maze_task import MazeTask

#: Typical failures that are drawn, and the size of their pictures [pixels].
TYPICAL, WIDTH, HEIGHT = 4, 400, 300

_BAD, _GOOD, _MEAN = "#D55E00", "#B8C4BE", "#0072B2"


@dataclass(frozen=True)
class FailureOptions:
    """Settings of ``python -m experiments.failures``."""

    policy: str = option("all", "shipped policies or files *.npz, separated by commas; all: every shipped one")
    run: str = option("none", "instead of policy: folder of a seed")
    episodes: int = option(2_000, "episodes of each policy; proportionally fewer where T is more than 500 steps", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    results: str = option("default", "folder of CSV file and pictures; default: experiments/results, or the run's own")


@dataclass(frozen=True)
class Episodes:
    """What happened, and where it began.

    Attributes:
        qpos: (E, nq) starts.
        distance: (E,) of them to the goal [m].
        subsets: which are in each of the task's parts of S^0, {name: (E,) bool}.
        failed: for each of the policy's actions, (E,) bool.
        separations: of the failures of the stochastic policy.
    """

    qpos: np.ndarray
    distance: np.ndarray
    subsets: Mapping[str, np.ndarray]
    failed: Mapping[str, np.ndarray]
    separations: Sequence[Separation]


def _cells(kind: str, name: str, inside: np.ndarray, failed: np.ndarray) -> dict[str, Any]:
    count, failures = int(inside.sum()), int((failed & inside).sum())
    low, high = wilson_interval(failures, count)
    return {
        "region_kind": kind,
        "region": name,
        "episodes": count,
        "failures": failures,
        "failure_rate": round(failures / count, 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "share_of_starts": round(count / len(inside), 4),
        "share_of_failures": round(failures / failed.sum(), 4) if failed.any() else "",
    }


def region_rows(seen: Episodes, names: Sequence[str]) -> list[dict[str, Any]]:
    """Failures by region, of both ways to act.

    Args:
        seen: the episodes.
        names: of the coordinates.
    """
    rows: list[dict[str, Any]] = []
    regions = make_regions(seen.distance, seen.subsets, *(~seen.failed[name] for name in ACTIONS))
    for actions in ACTIONS:
        failed = seen.failed[actions]
        for region in regions:
            solved = region.successes_mean if actions == "mean" else region.successes_stochastic
            # Only its counts are known: as many starts, as many failures.
            inside, lost = np.arange(len(failed)) < region.episodes, region.episodes - solved
            cells = _cells(region.kind, region.name, inside, np.arange(len(failed)) < lost)
            cells["share_of_failures"] = round(lost / failed.sum(), 4) if failed.any() else ""
            rows.append({"actions": actions, **cells})
        for one in seen.separations:
            name, value = names[one.coordinate], seen.qpos[:, one.coordinate]
            for k, (low, high) in enumerate(zip(one.edges[:-1], one.edges[1:])):
                last = k == len(one.starts) - 1
                inside = (value >= low) & ((value <= high) if last else (value < high)) & one.among
                rows.append(
                    {"actions": actions, **_cells("coordinate", f"{name} {low:.2f} to {high:.2f}", inside, failed)}
                )
            rows.append({"actions": actions, **_cells("range", one.words(name), one.inside(seen.qpos), failed)})
    return rows


def _bars(axes: Axes, edges: np.ndarray, values: np.ndarray, seen: Episodes) -> None:
    """Share of episodes that fail between ``edges`` of ``values`` (E,): bars: stochastic policy, line: mean action."""
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(place, minlength=len(edges) - 1), 1)
    shares = {name: np.bincount(place, seen.failed[name], minlength=len(edges) - 1) / count for name in ACTIONS}
    axes.bar(edges[:-1], shares["stochastic"], np.diff(edges), align="edge", color=_BAD, alpha=0.75, ec="white", lw=0.8)
    axes.stairs(shares["mean"], edges, color=_MEAN, lw=2)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_ylim(0, min(1.0, 1.18 * max(0.02, *(float(x.max()) for x in shares.values()))))
    axes.grid(axis="x", visible=False)


def _by_distance(axes: Axes, seen: Episodes) -> None:
    edges = np.linspace(0, float(seen.distance.max()) * (1 + 1e-6), 11)
    _bars(axes, edges, seen.distance, seen)
    axes.set(xlabel="distance of the start [m]", title="failures by distance", xlim=(0, edges[-1]))


def _by_coordinate(axes: Axes, seen: Episodes, one: Separation, name: str, line: str) -> None:
    chosen = one.among
    part = Episodes(seen.qpos[chosen], seen.distance[chosen], {}, {k: v[chosen] for k, v in seen.failed.items()}, ())
    _bars(axes, one.edges, part.qpos[:, one.coordinate], part)
    axes.axvspan(one.edges[one.first], one.edges[one.last + 1], color="0.9", zorder=0, lw=0)
    title = f"by {name}" if one.among.all() else f"others, by {name}"
    axes.set(xlabel=f"{name}, quantile bins\nshaded: {line}", title=title, xlim=(one.edges[0], one.edges[-1]))


def _plan(axes: Axes, task: MazeTask, seen: Episodes, shown: np.ndarray) -> None:
    """A maze from above, with the starts of the stochastic policy's failures."""
    xy, failed = np.asarray(task.grid_coordinates(seen.qpos)), seen.failed["stochastic"]
    for geom in static_geoms(task.model):
        axes.fill(*outline(geom, (0, 1)).T, color="0.8", lw=0)
    axes.scatter(xy[~failed, 0], xy[~failed, 1], s=4, color=_GOOD, lw=0)
    axes.scatter(xy[failed, 0], xy[failed, 1], s=7, color=_BAD, lw=0)
    axes.plot(*task.goal, marker="*", ms=13, color="#FFD21F", mec="0.1", mew=0.8, ls="")
    for number, row in enumerate(shown, 1):
        box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": "0.2", "lw": 0.8}
        axes.text(xy[row, 0], xy[row, 1], str(number), ha="center", va="center", fontsize=8, bbox=box)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="starts that failed")
    axes.grid(visible=False)


def draw(name: str, task: Task, seen: Episodes, path: Path, about: str) -> str:
    """Draws the picture of a policy; returns what could not be drawn, in words, or nothing.

    Args:
        name: of the policy.
        task: its task.
        seen: the episodes; some failed.
        path: file to write.
        about: commit and number of episodes, for the small print.
    """
    style.use()
    failed, names = seen.failed["stochastic"], coordinate_names(task.model)
    candidates = np.flatnonzero(failed)
    rows, shares = typical(np.asarray(task.grid_coordinates(seen.qpos[candidates])), TYPICAL)
    shown, pictures, lacking = candidates[rows], [], ""
    try:
        with open_scene(task.model, WIDTH, HEIGHT, "overview") as scene:
            pictures = [scene(seen.qpos[row]) for row in shown]
    except RenderError as error:
        lacking = f"without pictures of the starts: {error}"
    figure = Figure(figsize=(style.WIDTH, 5.6 if pictures else 3.4), layout="constrained")
    grid = figure.add_gridspec(2 if pictures else 1, 12, height_ratios=(3.1, 2.2) if pictures else (1,))
    lines = as_words(names, seen.separations, seen.qpos, failed)
    maze = isinstance(task, MazeTask)
    panels = 2 if maze else 1 + len(seen.separations)
    all_axes = [figure.add_subplot(grid[0, 12 * k // panels : 12 * (k + 1) // panels]) for k in range(panels)]
    _by_distance(all_axes[0], seen)
    if isinstance(task, MazeTask):
        _plan(all_axes[1], task, seen, shown)
    else:
        for axes, one, line in zip(all_axes[1:], seen.separations, lines):
            _by_coordinate(axes, seen, one, names[one.coordinate], line.split(": ")[1].replace(" and ", ",\n"))
    all_axes[0].set_ylabel("episodes that fail")
    style.legend(figure, [("stochastic policy", _BAD, "-"), ("its mean action", _MEAN, "-")])
    for number, (picture, row, share) in enumerate(zip(pictures, shown, shares), 1):
        axes = figure.add_subplot(grid[1, 3 * number - 3 : 3 * number])
        axes.imshow(picture)
        axes.set_axis_off()
        axes.set_title(
            f"{number}: {seen.distance[row]:.2f} m, for {100 * share:.0f} % of the failures", fontsize=8.5, loc="left",
            fontweight="normal", pad=3,
        )  # fmt: skip
    small = [f"{style.title(name)}: {about}"]
    if pictures:
        small.append(
            "Below: starts in the middle of clusters of those that failed, with the share of failures in each."
        )
    style.note(figure, small)
    style.save(figure, path)
    return lacking


def look(subject: Subject, chosen: FailureOptions) -> tuple[Task, Episodes]:
    """Plays the episodes of a policy.

    Raises:
        ConfigError: it cannot be loaded, or its task has no feasible starts.
    """
    loaded = subject.load()
    task = loaded.task
    result = play(loaded, task, episodes=fewer(chosen.episodes, task.horizon), seed=chosen.seed)
    qpos, subsets, distance = starts(task, result)
    failed = {name: ~np.asarray(getattr(result, name).success) for name in ACTIONS}
    return task, Episodes(qpos, distance, subsets, failed, separate(qpos, failed["stochastic"]))


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """The ranges of the CSV file for a page."""
    lines = ["| policy | failures: stochastic, mean action | where | starts there | failures there |", "|" + "---|" * 5]
    for name in dict.fromkeys(row["policy"] for row in rows):
        mine = [row for row in rows if row["policy"] == name]
        total = {row["actions"]: f"{100 * float(row['failure_rate']):.1f} %" for row in mine if row["region"] == "all"}
        first = [name, ", ".join(total[actions] for actions in ACTIONS)]
        ranges = [row for row in mine if row["region_kind"] == "range" and row["actions"] == "stochastic"]
        for k, row in enumerate(ranges):
            shares = [f"{100 * float(row[f'share_of_{what}']):.0f} %" for what in ("starts", "failures")]
            where = ("else " if k else "") + row["region"]
            lines.append(f"| {' | '.join([*(first if k == 0 else ['', '']), where, *shares])} |")
        if not ranges:
            lines.append(f"| {' | '.join(first)} | no coordinate tells | | |")
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Plays, writes and draws; returns the exit code."""
    chosen = options(FailureOptions, "experiments.failures")
    enable_compilation_cache()
    found = subjects(chosen.policy, chosen.run)
    results = folder(chosen.results, chosen.run)
    for subject in found:
        begin, about = time.monotonic(), machine()
        task, seen = look(subject, chosen)
        names, failed = coordinate_names(task.model), seen.failed["stochastic"]
        cells = {"policy": subject.name, "task": task.name}
        rows = merge(
            results / "failures.csv",
            [{**cells, **row, "seed": chosen.seed, **about} for row in region_rows(seen, names)],
        )
        path = results / f"failures_{subject.file}.png"
        words = f"{failed.sum()} of {len(failed)} episodes of the stochastic policy failed"
        words += f", {seen.failed['mean'].sum()} of its mean action"
        print(f"{subject.name}: {words} ({time.monotonic() - begin:.0f} s)", flush=True)
        print("".join(f"  {line}\n" for line in as_words(names, seen.separations, seen.qpos, failed)), end="")
        if not failed.any():
            path.unlink(missing_ok=True)  # of a policy that failed
            continue
        lacking = draw(task.name, task, seen, path, f"{words}; commit {about['commit']}.")
        print(f"  {path} {lacking}".rstrip(), flush=True)
    print(f"\n{markdown(rows)}\n\n{results / 'failures.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
