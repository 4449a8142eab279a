"""How the starts grew: the starts of every iteration in plan, and from the side where that shows more."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from rcg_jax.config.settings import CurriculumConfig
from rcg_jax.report.outcomes import Outcomes
from rcg_jax.report.points import Locator, evenly
from rcg_jax.report.scenery import outline, static_geoms
from rcg_jax.runs.load import LoadedRun
from rcg_jax.runs.start_record import StartRecord
from rcg_jax.types import StartLabels

#: Iterations that the page shows, at most; of longer runs evenly chosen ones.
MOST_FRAMES = 400

#: Feasible starts drawn behind the others.
MOST_FEASIBLE = 1500

#: A view from the side is drawn where the starts' heights differ by this share of their extent in plan.
_SIDE_FROM = 0.15

#: Of static geoms this far beyond what the starts span, in units of that span, the view shows no more.
_BEYOND = 0.75

_STEPS = 2**15 - 1


def kinds(labels: StartRecord | StartLabels, config: CurriculumConfig) -> np.ndarray:
    """The kind of each start, (n,): 0 too hard, 1 good, 2 mastered, 3 too few episodes to say."""
    successes, episodes = np.asarray(labels.successes), np.asarray(labels.episodes)
    rate = successes / np.maximum(episodes, 1)
    kind = np.where(rate < config.r_min, 0, np.where(rate > config.r_max, 2, 1))
    return np.where(episodes < config.min_episodes, 3, kind)


def _pack(values: np.ndarray, dtype: str) -> str:
    """Numbers as base64 of little-endian ones, for the page."""
    return base64.b64encode(np.asarray(values).astype(np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


class Frame:
    """The part of the world that the views show, and points in it as integers."""

    def __init__(self, points: np.ndarray, geoms: Sequence[np.ndarray]) -> None:
        """Args: points (K, 3) [m] that have to be in it; geoms as of :func:`rcg_jax.report.scenery.static_geoms`."""
        low, high = points.min(axis=0), points.max(axis=0)
        span = max(float((high - low).max()), 1e-3)
        for geom in geoms:
            geom_low, geom_high = geom.min(axis=0), geom.max(axis=0)
            if np.all(geom_low > low - _BEYOND * span) and np.all(geom_high < high + _BEYOND * span):
                low, high = np.minimum(low, geom_low), np.maximum(high, geom_high)
        self.low, self.high = low - 0.04 * span, high + 0.04 * span
        self.centre, self.step = (self.low + self.high) / 2, float(np.max(self.high - self.low) / 2 / _STEPS)

    def pack(self, points: np.ndarray) -> str:
        """Points (K, 3) as integers from -32767 to 32767; -32768 where they are not finite or far outside."""
        scaled = (points - self.centre) / self.step
        fine = (np.abs(scaled) <= _STEPS).all(axis=1, keepdims=True)  # comparisons with NaN are false
        return _pack(np.where(fine, np.nan_to_num(scaled), -_STEPS - 1).round(), "i2")


def growth(
    run: LoadedRun,
    locator: Locator,
    records: Sequence[StartRecord],
    feasible: np.ndarray,
    outcomes: Outcomes | None,
) -> dict[str, Any]:
    """What the page's views of the starts show: ``records`` by iteration, ``feasible`` starts (K, nq), may be none."""
    config, geoms = run.config.curriculum, static_geoms(run.task.model)
    shown = [records[k] for k in evenly(len(records), MOST_FRAMES) if len(records[k].qpos)]
    number = [len(one.qpos) for one in shown]
    behind = feasible[evenly(len(feasible), MOST_FEASIBLE)]
    ends = outcomes.qpos if outcomes else behind[:0]
    every = locator(np.concatenate([*(one.qpos for one in shown), behind, ends])).point
    starts, behind, ends = np.split(every, np.cumsum([sum(number), len(behind)]))
    # A few starts that flew away must not make the rest small.
    inside = every[np.isfinite(every).all(axis=1)]
    low, high = np.percentile(inside, [0.5, 99.5], axis=0)
    room = 0.5 * (high - low).max()
    inside = inside[np.all((inside >= low - room) & (inside <= high + room), axis=1)]
    frame = Frame(np.concatenate([inside, locator.goal[None]]), geoms)
    return {
        "iterations": [one.iteration for one in shown],
        "number": number,
        "points": frame.pack(starts),
        "kinds": _pack(np.concatenate([kinds(one, config) for one in shown]), "u1"),
        "successes": _pack(np.concatenate([one.successes for one in shown]), "u2"),
        "episodes": _pack(np.concatenate([one.episodes for one in shown]), "u2"),
        "feasible": frame.pack(behind),
        "finals": {"points": frame.pack(ends), "reached": _pack(outcomes.stochastic, "u1")} if outcomes else None,
        "unit": {"centre": frame.centre.tolist(), "step": frame.step},
        "goal": locator.goal.tolist(),
        "name": locator.name,
        "thresholds": [config.r_min, config.r_max],
        "views": [_view(frame, geoms, axes, title) for axes, title in _views(inside)],
    }


def _views(points: np.ndarray) -> list[tuple[tuple[int, int], str]]:
    """(axes, title) of the views that show points (K, 3)."""
    extent = points.max(axis=0) - points.min(axis=0)
    views = [((0, 1), "from above")]
    if extent[2] > _SIDE_FROM * max(extent[:2]):
        views.append(((0, 2), "from the front") if extent[0] >= extent[1] else ((1, 2), "from the side"))
    return views


def _view(frame: Frame, geoms: Sequence[np.ndarray], axes: tuple[int, int], title: str) -> dict[str, Any]:
    outlines = [corners.round(4).tolist() for geom in geoms if len(corners := outline(geom, axes))]
    low, high = frame.low[[*axes]].tolist(), frame.high[[*axes]].tolist()
    return {"axes": [*axes], "title": title, "low": low, "high": high, "outlines": outlines}
