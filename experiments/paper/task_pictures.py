"""Pictures of the tasks, as the paper's figures 1 and 4: goal states, and samples of the feasible starts.

    python -m experiments.paper.task_pictures                        # all registered tasks
    python -m experiments.paper.task_pictures tasks=examples/reacher/reacher.py:Reacher results=.

Writes ``tasks.png``, every task in its goal state, and for each task ``starts_<task>.png``, six of its feasible starts:
one from the middle of each sixth of S^0, ordered by the distance to the goal as a straight line. A maze's has S^0 from
above beside them, with the place of each of the six. Without OpenGL it says so and ends.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from experiments.common import RESULTS, options
from experiments.paper import style
from rcg_jax.config.settings import option
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.report.points import Locator
from rcg_jax.report.scene import RenderError, open_scene
from rcg_jax.report.scenery import outline, static_geoms
from rcg_jax.tasks import TASKS, Task, make_task
from rcg_jax.tasks.maze_task import MazeTask
from rcg_jax.types import StartSet

#: Size of one picture [pixels], and how many stand side by side.
WIDTH, HEIGHT, COLUMNS = 384, 288, 3

#: Pictures of starts per task.
SAMPLES = 6

#: Starts in a view from above.
POINTS = 4_000


@dataclass(frozen=True)
class PictureOptions:
    """Settings of ``python -m experiments.paper.task_pictures``."""

    tasks: str = option(",".join(TASKS), "tasks, separated by commas")
    results: str = option(str(RESULTS), "folder of the pictures")


def sheet(pictures: Sequence[np.ndarray], captions: Sequence[str]) -> Image.Image:
    """Pictures (height, width, 3) side by side, in rows, each with its caption."""
    height, width = pictures[0].shape[:2]
    columns = 2 if len(pictures) == 4 else min(COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    page = Image.new("RGB", (columns * width, rows * height), "white")
    draw = ImageDraw.Draw(page, "RGBA")
    font = ImageFont.load_default(max(9, height // 18))
    pad = height // 60
    for i, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        x, y = i % columns * width, i // columns * height
        page.paste(Image.fromarray(picture), (x, y))
        box = draw.textbbox((x + 2 * pad, y + 2 * pad), caption, font=font)
        draw.rectangle((box[0] - pad, box[1] - pad, box[2] + pad, box[3] + pad), fill=(255, 255, 255, 200))
        draw.text((x + 2 * pad, y + 2 * pad), caption, font=font, fill=(30, 30, 30))
        draw.rectangle((x, y, x + width - 1, y + height - 1), outline="white")
    return page


def save(page: Image.Image, path: Path) -> None:
    """Writes a PNG of 256 colours, a third of the size of one of all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def spread(task: Task, starts: StartSet) -> tuple[np.ndarray, np.ndarray]:
    """Starts (6, nq) from the middle of each sixth of a set ordered by distance, and their distances [m]."""
    distance = np.asarray(jit(lambda s: jax.vmap(task.distance)(task.snapshot(task.reset(s))))(starts))
    order = np.argsort(distance, kind="stable")
    chosen = order[((np.arange(SAMPLES) + 0.5) * len(order) / SAMPLES).astype(int)]
    return np.asarray(starts.take(jnp.asarray(chosen)).qpos), distance[chosen]


def from_above(task: MazeTask, starts: np.ndarray, chosen: np.ndarray, size: int) -> np.ndarray:
    """A square picture (size, size, 3) of a maze with where starts (K, nq) lie; ``chosen`` (6, nq) have numbers."""
    rows = starts[np.unique(np.linspace(0, len(starts) - 1, min(POINTS, len(starts))).astype(int))]
    locate = Locator(task, rows)
    places = locate(rows)
    style.use()
    figure = Figure(figsize=(size / 100, size / 100), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    for geom in static_geoms(task.model):
        axes.fill(*outline(geom, (0, 1)).T, color="0.8", lw=0)
    dots = axes.scatter(places.point[:, 0], places.point[:, 1], c=places.distance, s=3, cmap="viridis", lw=0)
    axes.plot(*task.goal, marker="*", ms=15, color="#FFD21F", mec="0.1", mew=0.8, ls="")
    for number, (x, y) in enumerate(locate(chosen).point[:, :2], 1):
        box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": "0.2", "lw": 0.8}
        axes.text(x, y, str(number), ha="center", va="center", fontsize=8, bbox=box)
    shown = len(rows) if len(rows) == len(starts) else f"{len(rows):,} of {len(starts):,}"
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"$S^0$ from above: {shown} starts")
    bar = figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.02)
    bar.set_label("straight line to the goal (star) [m]")
    axes.grid(visible=False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def see_through(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy in which a chain's links are half transparent, all but the last one, so that they hide no tool."""
    model = copy.deepcopy(model)
    moving = np.flatnonzero(model.body_weldid != 0)
    parents = model.body_parentid[moving]
    if len(set(parents)) == len(moving):  # no two links have the same parent
        links = np.isin(model.geom_bodyid, np.intersect1d(moving, parents))
        model.geom_rgba[links, 3] = 0.35
    return model


def draw_starts(task: Task, out: Path) -> None:
    """Writes ``starts_<task>.png``, or says why not.

    Raises:
        RenderError: this machine cannot draw.
    """
    try:
        feasible = task.feasible_starts()
        qpos, distance = spread(task, feasible)
    except (FileNotFoundError, StartsFileError) as error:
        print(f"{task.name}: no picture of its starts: {error}")
        return
    with open_scene(see_through(task.model), WIDTH, HEIGHT, "overview") as draw:
        pictures = [draw(row) for row in qpos]
    page = sheet(pictures, [f"{k}: {d:.2f} m straight to goal" for k, d in enumerate(distance, 1)])
    if isinstance(task, MazeTask):
        above = from_above(task, np.asarray(feasible.qpos)[np.asarray(feasible.valid)], qpos, page.height)
        page = Image.fromarray(np.concatenate([above, np.asarray(page)], axis=1))
    save(page, out / f"starts_{task.name}.png")


def draw(tasks: Sequence[str], out: Path) -> None:
    """Writes all pictures.

    Raises:
        RenderError: this machine cannot draw.
        ValueError: a task that does not exist, or is broken.
    """
    enable_compilation_cache()
    goals = []
    made = [make_task(name, "native") for name in tasks]
    for task in made:
        with open_scene(task.model, WIDTH, HEIGHT, "overview") as draw:
            goals.append(draw(task.goal_state))
        draw_starts(task, out)
    save(sheet(goals, [task.name for task in made]), out / "tasks.png")


def main() -> int:
    """Draws all; returns the exit code."""
    chosen = options(PictureOptions, "experiments.paper.task_pictures")
    try:
        draw(chosen.tasks.split(","), Path(chosen.results))
    except RenderError as error:
        print(f"no pictures: {error}")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
