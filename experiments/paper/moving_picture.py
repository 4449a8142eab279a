"""The moving picture of the README: shipped policies at work from starts of rho_0, as an animated GIF.

    python -m experiments.paper.moving_picture

For each policy that comes with the package, episodes one after the other, those of all tasks side by side, with the
stochastic policy that is evaluated. The episodes are the first ones of a fixed seed, failures included.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from experiments.common import options
from rcg_jax.config.settings import option
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.policies.policy_file import shipped_policies
from rcg_jax.report.scene import RenderError, open_scene
from rcg_jax.report.video import Recording, record_episodes
from rcg_jax.runs.load import load_policy_with_task
from rcg_jax.tasks import TASKS, Task

#: Pictures per second, and how many of them a finished episode stays.
FPS, HOLD = 12, 6

GREEN, RED, GREY = (46, 160, 67), (207, 34, 46), (140, 140, 140)


@dataclass(frozen=True)
class MovingOptions:
    """Settings of ``python -m experiments.paper.moving_picture``."""

    out: str = option("experiments/results/policies.gif", "file to write")
    seconds: float = option(8.0, "length", unit="s", above=0)
    width: int = option(200, "of each task's picture", unit="pixels", low=16)
    slowest: float = option(2.5, "episodes of longer duration are shown faster", unit="s", above=0)
    seed: int = option(0, "of the starts and of the action noise", low=0)


def strip(task: Task, recordings: Sequence[Recording], settings: MovingOptions) -> list[Image.Image]:
    """The pictures of one task: its episodes one after the other until the time is up."""
    number, size = round(settings.seconds * FPS), settings.width
    slowest = max(len(one.qpos) for one in recordings) * task.model.opt.timestep
    step = max(1, round(max(1.0, slowest / settings.slowest) / FPS / task.model.opt.timestep))
    pictures: list[Image.Image] = []
    font = ImageFont.load_default(max(9, size // 18))
    with open_scene(task.model, size, size * 3 // 4, "overview") as draw:
        for one in recordings:
            last = len(one.qpos) - 1
            steps = [*range(0, last, step), *[last] * HOLD]
            for at in steps[: number - len(pictures)]:
                image = Image.fromarray(draw(one.qpos[at]))
                colour = GREY if at < last else GREEN if one.success else RED
                pen = ImageDraw.Draw(image)
                pen.text((6, 4), task.name, font=font, fill=(30, 30, 30))
                pen.rectangle((0, 0, image.width - 1, image.height - 1), outline=colour, width=3)
                pictures.append(image)
            if len(pictures) == number:
                break
    return pictures + [pictures[-1]] * (number - len(pictures))


def main() -> int:
    """Draws the picture; returns the exit code."""
    settings = options(MovingOptions, "experiments.paper.moving_picture")
    out, names = Path(settings.out), [name for name in TASKS if name in shipped_policies()]
    wrong = (
        f"out={out}: must end with .gif" if out.suffix.lower() != ".gif"
        else f"out={out}: is a folder" if out.is_dir()
        else f"out={out}: its folder does not exist" if not out.parent.is_dir()
        else f"out={out}: its folder cannot be written" if not os.access(out.parent, os.W_OK)
        else "no policies come with this installation" if not names
        else ""
    )  # fmt: skip
    if wrong:
        print(f"error: {wrong}", file=sys.stderr)
        return 2
    enable_compilation_cache()
    strips = []
    try:
        for name in names:
            run = load_policy_with_task(name, engine="native")
            recordings = record_episodes(run, episodes=12, seed=settings.seed, deterministic=False)
            strips.append(strip(run.task, recordings, settings))
    except RenderError as error:
        print(error, file=sys.stderr)
        return 2
    pages = []
    for pictures in zip(*strips, strict=True):
        page = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures], axis=1))
        pages.append(page.quantize(64, dither=Image.Dither.NONE))
    pages[0].save(
        settings.out, save_all=True, append_images=pages[1:], duration=round(1000 / FPS), loop=0, optimize=True
    )
    print(
        f"{settings.out}: {len(names)} tasks, {len(pages)} pictures, {Path(settings.out).stat().st_size / 1e6:.1f} MB"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
