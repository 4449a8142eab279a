"""Short videos of a policy's successes and failures, small enough to be part of a page."""

from __future__ import annotations

import base64
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rcg_jax.report.video import record_episodes, write_video
from rcg_jax.runs.load import LoadedRun

#: Episodes that the shown ones are chosen from, and the seed of their starts and actions.
_EPISODES, _SEED = 40, 0

#: Size of the pictures [pixels], and how many of them a second has.
_WIDTH, _HEIGHT, _FPS = 360, 270, 15

#: What an episode may last in the video [s]: longer ones are shown faster.
_LONGEST_S = 4.0


def make_videos(run: LoadedRun, number: int) -> list[dict[str, Any]]:
    """A video of at most ``number`` successes and one of as many failures, as data URLs with captions.

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
        # Starts from near to far: those in the middle of equal parts, neither the very nearest nor the very furthest.
        found.sort(key=lambda one: float(one.distance[0]))
        count = min(number, len(found))
        chosen = [found[int((k + 0.5) * len(found) / count)] for k in range(count)]
        # 1, 2, 4, ... times as fast as the simulation, so that the longest of them fits its time.
        longest = max(len(one.qpos) - 1 for one in chosen) * float(run.task.model.opt.timestep)
        speed = int(2 ** max(0, np.ceil(np.log2(longest / _LONGEST_S) - 1e-9)))
        pace = "" if speed == 1 else f", {speed} times as fast as the simulation"
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "video.mp4"
            write_video(run.task, chosen, out, fps=_FPS, speed=speed, width=_WIDTH, height=_HEIGHT, progress=False)
            content = base64.b64encode(out.read_bytes()).decode()
        videos.append(
            {
                "title": title,
                "source": f"data:video/mp4;base64,{content}",
                "caption": f"{len(chosen)} of the {len(found)} among {_EPISODES} episodes from feasible starts{pace}",
            }
        )
    return videos
