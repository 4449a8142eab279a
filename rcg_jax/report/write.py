"""The report of one run: gathers its parts, leaves out what cannot be had and says so."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

import rcg_jax
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.manifest import brief
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.io.tables import write_atomically
from rcg_jax.report.data import RunData, curves, headline, read_run, settings, small_curves
from rcg_jax.report.growth import growth
from rcg_jax.report.outcomes import final_outcomes, robustness, success
from rcg_jax.report.page import page
from rcg_jax.report.points import Locator, feasible_states
from rcg_jax.report.scene import RenderError
from rcg_jax.report.video import make_videos
from rcg_jax.runs.checkpoint import iterations
from rcg_jax.runs.load import LoadedRun, load_run
from rcg_jax.runs.start_record import read_starts


def write_report(folder: Path, out: Path | None = None, *, videos: int = 3) -> list[str]:
    """Writes the report of a run; returns what it lacks and why, each in one line.

    Args:
        folder: a seed's folder ``<run_dir>/<task>/<method>/seed<k>``.
        out: the page; ``report.html`` in the run's folder by default.
        videos: episodes of each kind in the videos, at most; 0: none.

    Raises:
        ConfigError: no run there, or no finished iteration.
        OSError: the page cannot be written.
    """
    data = read_run(folder)
    left_out = [*data.damage]
    title, detail = headline(data)
    content: dict[str, Any] = {
        "kind": "run",
        "title": data.name,
        "headline": title,
        "detail": detail,
        "settings": settings(data.config),
        "small": small_curves(list(data.metrics)),
        "runs": [{"label": data.name, **curves(data)}],
        "starts": None,
        "final": None,
        "robustness": [],
        "videos": [],
        "about": _about(data),
    }
    try:
        content["robustness"] = robustness(folder)
    except (ValueError, TypeError, OSError) as error:
        left_out.append(f"no robustness: {folder / 'robustness.csv'}: {brief(error)}")
    try:
        if not iterations(folder / "checkpoints"):
            raise ConfigError("it has no checkpoint yet")
        # On a CPU with C MuJoCo: nothing of its physics has to be compiled there.
        run = load_run(folder, engine="native" if jax.default_backend() == "cpu" else None)
    except ConfigError as error:
        left_out.append(f"no starts, regions and videos: {error}")
    else:
        _add_places(content, run, left_out)
        try:
            content["videos"] = make_videos(run, videos) if videos else []
        except (RenderError, StartsFileError, OSError) as error:
            left_out.append(f"no videos: {brief(error)}")
    content["left_out"] = left_out
    write_atomically(out or folder / "report.html", page(data.name, content).encode())
    return left_out


def _about(data: RunData) -> list[list[str]]:
    config = data.config
    device = jax.devices()[0].device_kind if jax.default_backend() != "cpu" else "a CPU"
    broken = int(np.sum(data.metrics.get("nonfinite", 0)))
    return [
        ["task", config.task],
        ["method", config.method],
        ["engine", config.engine],
        ["seed", str(config.seed)],
        ["iterations", f"{data.iterations} of {config.iterations}"],
        *([["episodes ended by non-finite physics or observations", f"{broken:,}"]] if broken else []),
        ["folder", str(data.path.absolute())],
        ["report written", f"{datetime.datetime.now():%Y-%m-%d %H:%M} on {device}"],
        ["versions", f"rcg_jax {rcg_jax.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__}"],
    ]


def _add_places(content: dict[str, Any], run: LoadedRun, left_out: list[str]) -> None:
    """Adds what depends on where starts are: how they grew, and the final success by region."""
    nq = run.task.model.nq
    records = [one for one in read_starts(run.path / "starts.csv") if one.qpos.shape[1:] == (nq,)]
    feasible, lacking = feasible_states(run.task)
    locator, outcomes = Locator(run.task, np.concatenate([feasible, *(one.qpos for one in records[-1:])])), None
    if lacking:
        left_out.append(f"no success by region: {lacking}")
    else:
        outcomes = final_outcomes(run, feasible)
        content["final"] = success(outcomes, locator(outcomes.qpos), run.task.part_names)
    if records:
        content["starts"] = growth(run, locator, records, feasible, outcomes)
    else:
        file = run.path / "starts.csv"
        left_out.append(f"no growth of the starts: {file} has none (it was made by an older version?)")
