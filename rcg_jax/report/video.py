"""Videos of a policy at work."""

from __future__ import annotations

import base64
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rcg_jax.report.scene import open_scene

if TYPE_CHECKING:  # these import mujoco, which fails where MUJOCO_GL asks for a library that is not installed
    from rcg_jax.runs.load import Trained
    from rcg_jax.tasks.base import Task

#: Colours of the frame around a picture (Okabe and Ito's palette, distinct for the colour-blind): an episode that is
#: still going on, one that reached the goal, one that did not.
RUNNING, SUCCESS, FAILURE = (150, 150, 150), (0, 158, 115), (213, 94, 0)

#: How long the last state of an episode stays in the picture [s].
HOLD_S = 0.6

#: Episodes that the shown ones are chosen from, and the seed of their starts and actions.
_EPISODES, _SEED = 40, 0

#: Size of the pictures [pixels], and how many of them a second has.
_WIDTH, _HEIGHT, _FPS = 360, 270, 15

#: What an episode may last in the video [s]: longer ones are shown faster.
_LONGEST_S = 4.0


@dataclass(frozen=True)
class Recording:
    """One episode.

    Attributes:
        qpos: (length + 1, nq) positions, from the start to the last state.
        distance: (length + 1,) distance to the goal [m].
        success: whether it reached the goal.
    """

    qpos: np.ndarray
    distance: np.ndarray
    success: bool


def record_episodes(run: Trained, *, episodes: int, seed: int, deterministic: bool) -> list[Recording]:
    """Runs the policy from starts of rho_0, as the evaluation does, and keeps the states.

    The engine of ``run.task`` does the physics; ``deterministic``: act by the policy's mean.

    Raises:
        FileNotFoundError: the task has no feasible starts.
        StartsFileError: their file is damaged.
    """
    import jax
    import jax.numpy as jnp

    from rcg_jax.physics.jit import jit
    from rcg_jax.rl.hold import decisions, hold
    from rcg_jax.rl.policy import Actor
    from rcg_jax.types import PhysicsState, Snapshot, sample_starts

    task, policy = run.task, run.pi
    start_key, noise_key = jax.random.split(jax.random.key(seed))
    starts = sample_starts(start_key, task.feasible_starts(), episodes)

    def simulate(actor: Actor) -> Any:
        first = task.reset(starts)

        def look(s: Snapshot) -> Any:
            return s.qpos, task.distance(s), task.is_goal(s), task.is_failure(s)

        def act(carry: tuple[PhysicsState, Any], t: Any) -> tuple[tuple[PhysicsState, Any], Any]:
            physics, obs = carry
            dist = policy(actor.policy, actor.norm(obs))
            noise = jax.random.normal(jax.random.fold_in(noise_key, t), dist.mean.shape)
            action = dist.sample(noise * (not deterministic))
            physics, s, ((qpos, distance, goal, failure), bad) = hold(task, physics, action, policy.action_repeat, look)
            goal &= ~bad
            # Observations as the evaluation computes them, to the last bit.
            return (physics, jax.vmap(task.observe)(s)), (qpos, distance, goal, goal | failure | bad)

        seen = jax.lax.scan(
            act, (first, task.observe_batch(first)), jnp.arange(decisions(task.horizon, policy.action_repeat))
        )[1]
        qpos, distance, goal, ended = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: task.horizon], seen)
        begin = jax.vmap(task.distance)(task.snapshot(first))
        return jnp.concatenate([first.qpos[None], qpos]), jnp.concatenate([begin[None], distance]), goal, ended

    qpos, distance, goal, ended = jax.device_get(jit(simulate)(run.actor))
    lengths = np.where(ended.any(axis=0), ended.argmax(axis=0) + 1, task.horizon)
    return [
        Recording(qpos[: length + 1, i], distance[: length + 1, i], bool(goal[length - 1, i]))
        for i, length in enumerate(lengths)
    ]


def write_video(
    task: Task,
    recordings: Sequence[Recording],
    out: Path,
    *,
    fps: int = 25,
    speed: float = 1.0,
    width: int = 640,
    height: int = 480,
    camera: str = "overview",
    progress: bool = True,
) -> int:
    """Draws episodes into an mp4, one after the other; returns the number of pictures.

    Args:
        task, recordings: the episodes and their task.
        out: file to write; it appears when it is complete.
        fps, width, height: pictures per second and their size [pixels], even.
        speed: how many times as fast as in the simulation time passes.
        camera: name of one of the model's cameras; any other name: MuJoCo's free camera.
        progress: show a bar.

    Raises:
        RenderError: this machine cannot draw.
        OSError: the file cannot be written.
    """
    import imageio.v2 as imageio
    from tqdm import tqdm

    dt = float(task.model.opt.timestep)
    frames = [
        (number, *frame)
        for number, one in enumerate(recordings)
        for frame in _frames(len(one.qpos) - 1, fps / speed * dt, max(1, round(HOLD_S * fps)))
    ]
    partial = out.with_name(f".{out.stem}.new{out.suffix}")
    try:
        with (
            warnings.catch_warnings(),
            open_scene(task.model, width, height, camera) as draw,
            # Pictures of any even size; the default would scale them to a multiple of 16.
            cast(Any, imageio.get_writer(partial, fps=fps, macro_block_size=2, quality=7)) as video,
        ):
            # JAX warns about forks; that of ffmpeg does nothing before it becomes another program.
            warnings.filterwarnings("ignore", message=r"os\.fork", category=RuntimeWarning)
            interval = 0.2 if sys.stderr.isatty() else 5.0
            bar = tqdm(frames, desc="drawing", unit="picture", mininterval=interval, disable=not progress)
            for number, step, ended in bar:
                one = recordings[number]
                episode = f"{task.name}, episode {number + 1} of {len(recordings)}"
                title = f"{episode}, start {one.distance[0]:.2f} m from goal"
                status, colour = f"{step * dt:.2f} s, {one.distance[step]:.2f} m from goal", RUNNING
                if ended and one.success:
                    status, colour = f"goal reached after {step * dt:.2f} s", SUCCESS
                elif ended:
                    status, colour = f"failure after {status}", FAILURE
                video.append_data(_annotate(draw(one.qpos[step]), title, status, colour))
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return len(frames)


def _frames(last: int, rate: float, hold: int) -> list[tuple[int, bool]]:
    """(step, whether the episode has ended) of its pictures: ``rate`` per step, and ``hold`` of the ``last`` one."""
    steps = [round(k / rate) for k in range(int(last * rate) + 1)]
    return [(step, False) for step in steps if step < last] + [(last, True)] * hold


def _annotate(picture: np.ndarray, title: str, status: str, colour: tuple[int, int, int]) -> np.ndarray:
    """The picture with a coloured frame, a title above and the status below."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = picture.shape[:2]
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    size = max(10, round(min(height / 26, width / 36)))
    font = ImageFont.load_default(size)
    border, pad = max(2, round(height / 100)), size // 2
    bar = size + 2 * pad
    bars = (
        (border, title, (255, 255, 255, 190), (30, 30, 30)),
        (height - border - bar, status, (*colour, 235), (255, 255, 255)),
    )
    for top, text, background, foreground in bars:
        draw.rectangle((border, top, width - 1 - border, top + bar - 1), fill=background)
        draw.text((border + pad, top + bar / 2), text, fill=foreground, font=font, anchor="lm")
    draw.rectangle((0, 0, width - 1, height - 1), outline=colour, width=border)
    return np.asarray(image)


def make_videos(run: Trained, number: int) -> list[dict[str, Any]]:
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
