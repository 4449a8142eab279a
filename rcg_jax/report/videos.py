"""Short videos of a policy's successes and failures, small enough to be part of a page."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcg_jax.report.video import Recording, record_episodes, write_video
from rcg_jax.runs.load import LoadedRun

#: Episodes that the shown ones are chosen from, and the seed of their starts and actions.
_EPISODES, _SEED = 40, 0

#: Size of the pictures [pixels], and how many of them a second has.
_WIDTH, _HEIGHT, _FPS = 360, 270, 15

#: What an episode may last in the video [s]: longer ones are shown faster.
_LONGEST_S = 4.0


def make_videos(run: LoadedRun, number: int) -> list[dict[str, Any]]:
    """A video of successes and one of failures, as data URLs with captions.

    Args:
        run: the run; its task's engine does the physics.
        number: episodes in each, at most.

    Raises:
        RenderError: this machine cannot draw.
        OSError: the videos cannot be written.
        FileNotFoundError: the task has no feasible starts.
        StartsFileError: their file is damaged.
    """
    # Smooth edges would take more than half of the time where no GPU draws; the model is this run's own.
    run.task.model.vis.quality.offsamples = 0
    recordings = record_episodes(run, episodes=_EPISODES, seed=_SEED, deterministic=False)
    videos = []
    for success, title in ((True, "Successes"), (False, "Failures")):
        found = [one for one in recordings if one.success == success]
        if not found:
            continue
        chosen = _spread(found, number)
        speed = _speed(chosen, float(run.task.model.opt.timestep))
        pace = "" if speed == 1 else f", {speed} times as fast as the simulation"
        videos.append(
            {
                "title": title,
                "source": f"data:video/mp4;base64,{_encode(run, chosen, speed)}",
                "caption": f"{len(chosen)} of the {len(found)} among {_EPISODES} episodes from feasible starts{pace}",
            }
        )
    return videos


def _spread(recordings: Sequence[Recording], number: int) -> list[Recording]:
    """Some of the recordings, with starts from near to far."""
    by_distance = sorted(recordings, key=lambda one: float(one.distance[0]))
    # Those in the middle of as many equal parts: neither the very nearest nor the very furthest.
    count = min(number, len(by_distance))
    return [by_distance[int((k + 0.5) * len(by_distance) / count)] for k in range(count)]


def _speed(recordings: Sequence[Recording], timestep: float) -> int:
    """How many times faster than the simulation the longest of them fits its time: 1, 2, 4, 8, ..."""
    longest = max(len(one.qpos) - 1 for one in recordings) * timestep
    return int(2 ** max(0, np.ceil(np.log2(longest / _LONGEST_S) - 1e-9)))


def _encode(run: LoadedRun, recordings: Sequence[Recording], speed: int) -> str:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "video.mp4"
        write_video(run.task, recordings, out, fps=_FPS, speed=speed, width=_WIDTH, height=_HEIGHT, progress=False)
        return base64.b64encode(out.read_bytes()).decode()
