"""Videos of a policy at work.

``python -m rcg_jax.render run=DIR``, or ``policy=NAME``, writes an mp4 of episodes from rho_0;
:func:`rcg_jax.scene.render_still` draws one state.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rcg_jax.arguments import run_command
from rcg_jax.config import ConfigError, option
from rcg_jax.console import lenient_output
from rcg_jax.scene import RenderError, no_gl, open_scene, render_still

if TYPE_CHECKING:  # these import mujoco, which fails where MUJOCO_GL asks for a library that is not installed
    from rcg_jax.load import Trained
    from rcg_jax.tasks.task import Task

#: Colours of the frame around a picture (Okabe and Ito's palette, distinct for the colour-blind): an episode that is
#: still going on, one that reached the goal, one that did not.
RUNNING, SUCCESS, FAILURE = (150, 150, 150), (0, 158, 115), (213, 94, 0)

#: How long the last state of an episode stays in the picture [s].
HOLD_S = 0.6


@dataclass(frozen=True)
class RenderOptions:
    """Settings of ``python -m rcg_jax.render``."""

    run: str = option("", "folder of a seed: <run_dir>/<task>/<method>/seed<k>")
    policy: str = option("", "instead of run: name of a shipped policy, or a policy's file *.npz")
    task: str = option("", "of policy=...: the task to try it on; default: its own")
    episodes: int = option(6, "episodes, each from another start of rho_0", low=1, high=1000)
    out: str = option("", "file to write; default: rollouts.mp4 in the run's folder, or <policy>.mp4 here")
    actions: str = option("stochastic", "drawn from the policy, or its mean", choices=("stochastic", "mean"))
    fps: int = option(25, "pictures per second", low=1, high=100)
    speed: float = option(1.0, "how many times as fast as in the simulation time passes", above=0, high=1000)
    width: int = option(640, "width of the pictures, an even number", unit="pixels", low=160, high=3840)
    height: int = option(480, "height of the pictures, an even number", unit="pixels", low=120, high=2160)
    camera: str = option("overview", "camera of the model; free, or one that it does not have: MuJoCo's free camera")
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)


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

    Args:
        run: the run, or a policy with its task; the task's engine does the physics.
        episodes: how many.
        seed: of the starts and of the action noise.
        deterministic: act by the policy's mean.

    Raises:
        FileNotFoundError: the task has no feasible starts.
        StartsFileError: their file is damaged.
    """
    import jax
    import jax.numpy as jnp

    from rcg_jax.base import PhysicsState, Snapshot, sample_starts
    from rcg_jax.physics.compile import jit
    from rcg_jax.rl.hold import decisions, hold
    from rcg_jax.rl.policy import Actor

    task, policy = run.task, run.pi
    start_key, noise_key = jax.random.split(jax.random.key(seed))
    starts = sample_starts(start_key, task.feasible_starts(), episodes)

    def simulate(actor: Actor) -> tuple[Any, Any]:
        first = task.reset(starts)

        def look(s: Snapshot) -> Any:
            return s.qpos, task.distance(s), task.is_goal(s), task.is_failure(s)

        def act(physics: PhysicsState, t: Any) -> tuple[PhysicsState, Any]:
            dist = policy(actor.policy, actor.norm(task.observe_batch(physics)))
            noise = jax.random.normal(jax.random.fold_in(noise_key, t), dist.mean.shape)
            action = dist.sample(noise * (not deterministic))
            physics, _, ((qpos, distance, goal, failure), bad) = hold(task, physics, action, policy.action_repeat, look)
            goal &= ~bad
            return physics, (qpos, distance, goal, goal | failure | bad)

        start = first.qpos, jax.vmap(task.distance)(task.snapshot(first))
        actions = jnp.arange(decisions(task.horizon, policy.action_repeat))
        seen = jax.lax.scan(act, first, actions)[1]
        return start, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: task.horizon], seen)

    (qpos0, distance0), (qpos, distance, goal, ended) = jax.device_get(jit(simulate)(run.actor))
    recordings = []
    for i in range(episodes):
        length = int(np.argmax(ended[:, i])) + 1 if ended[:, i].any() else task.horizon
        recordings.append(
            Recording(
                qpos=np.concatenate([qpos0[None, i], qpos[:length, i]]),
                distance=np.concatenate([distance0[None, i], distance[:length, i]]),
                success=bool(goal[length - 1, i]),
            )
        )
    return recordings


def write_video(
    task: Task, recordings: Sequence[Recording], out: Path, options: RenderOptions, *, progress: bool = True
) -> int:
    """Draws episodes into an mp4, one after the other; returns the number of pictures.

    Args:
        task: their task.
        recordings: the episodes.
        out: file to write; it appears when it is complete.
        options: size, pictures per second, speed and camera.
        progress: show a bar.

    Raises:
        RenderError: this machine cannot draw.
        OSError: the file cannot be written.
    """
    import imageio.v2 as imageio
    from tqdm import tqdm

    dt = task.model.opt.timestep
    rate, hold = options.fps / options.speed, max(1, round(HOLD_S * options.fps))
    frames = [frame for number, one in enumerate(recordings) for frame in _frames(one, number, rate, dt, hold)]
    partial = out.with_name(f".{out.stem}.new{out.suffix}")
    try:
        with (
            warnings.catch_warnings(),
            open_scene(task.model, options.width, options.height, options.camera) as draw,
            # Pictures of any even size; the default would scale them to a multiple of 16.
            cast(Any, imageio.get_writer(partial, fps=options.fps, macro_block_size=2, quality=7)) as video,
        ):
            # JAX warns about forks; that of ffmpeg does nothing before it becomes another program.
            warnings.filterwarnings("ignore", message=r"os\.fork", category=RuntimeWarning)
            interval = 0.2 if sys.stderr.isatty() else 5.0
            for number, step, ended in tqdm(
                frames, desc="drawing", unit="picture", mininterval=interval, disable=not progress
            ):
                one = recordings[number]
                title = (
                    f"{task.name}, episode {number + 1} of {len(recordings)}, start {one.distance[0]:.2f} m from goal"
                )
                video.append_data(
                    _annotate(draw(one.qpos[step]), title, _status(one, step, dt, ended), _colour(one, ended))
                )
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return len(frames)


def _frames(one: Recording, number: int, rate: float, dt: float, hold: int) -> Iterator[tuple[int, int, bool]]:
    """(episode, step, whether it has ended) of every picture: ``rate`` per simulated second, ``hold`` at the end."""
    last = len(one.qpos) - 1
    for k in range(int(last * dt * rate) + 1):
        step = round(k / (rate * dt))
        if step < last:
            yield number, step, False
    for _ in range(hold):
        yield number, last, True


def _status(one: Recording, step: int, dt: float, ended: bool) -> str:
    if ended and one.success:
        return f"goal reached after {step * dt:.2f} s"
    return f"{'failure after ' if ended else ''}{step * dt:.2f} s, {one.distance[step]:.2f} m from goal"


def _colour(one: Recording, ended: bool) -> tuple[int, int, int]:
    return RUNNING if not ended else SUCCESS if one.success else FAILURE


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


def _brief(error: BaseException) -> str:
    return " ".join(str(error).split())[:100] or type(error).__name__


def _render(options: RenderOptions) -> None:
    for name in ("width", "height"):
        if getattr(options, name) % 2:
            raise ConfigError(f"{name}={getattr(options, name)}: must be even, mp4 needs that")
    if options.task and not options.policy:
        raise ConfigError(f"task={options.task}: only with policy=...; a run knows its task")
    default = Path(f"{Path(options.policy).stem}.mp4") if options.policy else Path(options.run) / "rollouts.mp4"
    out = Path(options.out) if options.out else default
    if out.suffix != ".mp4":
        raise ConfigError(f"out={out}: must end in .mp4")
    if options.out and not out.parent.is_dir():
        raise ConfigError(f"out={out}: no such folder {out.parent}")
    try:
        from rcg_jax.load import LoadedRun, load_policy_with_task, load_run
        from rcg_jax.physics.compile import enable_compilation_cache
        from rcg_jax.starts_file import StartsFileError
    except Exception as error:
        if os.environ.get("MUJOCO_GL"):  # mujoco loads that library when it is imported
            raise no_gl(error) from None
        raise

    enable_compilation_cache()
    # A few episodes: C MuJoCo on the host, whatever the run was trained on.
    run: Trained
    if options.policy:
        run = load_policy_with_task(options.policy, engine="native", task=options.task or None)
    else:
        run = load_run(Path(options.run), engine="native")
    for damage in run.damaged if isinstance(run, LoadedRun) else ():
        print(f"warning: {damage.path} is damaged ({damage.reason})", file=sys.stderr)
    model = run.task.model
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if options.camera not in (*cameras, "free"):
        known = f"it has {', '.join(cameras)}" if cameras else "it has none"
        print(f"camera={options.camera}: not in the model ({known}); using the free camera", file=sys.stderr)
    try:
        # Before the simulation: where nothing can be drawn, that is said at once.
        render_still(run.task, run.task.goal_state, width=options.width, height=options.height)
        recordings = record_episodes(
            run, episodes=options.episodes, seed=options.seed, deterministic=options.actions == "mean"
        )
        number = write_video(run.task, recordings, out, options)
    except (FileNotFoundError, StartsFileError) as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"out={out}: {error.strerror or _brief(error)}") from None
    good = sum(one.success for one in recordings)
    print(
        f"{out}: {good} of {len(recordings)} episodes reached the goal, {number / options.fps:.0f} s, "
        f"iteration {run.iteration}"
    )


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    argv = sys.argv[1:] if argv is None else argv
    return run_command(RenderOptions, "rcg_jax.render", argv, _render, (ConfigError, RenderError))


if __name__ == "__main__":
    sys.exit(main())
