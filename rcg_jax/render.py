"""Videos of a policy at work: ``python -m rcg_jax.render run=DIR``, or ``policy=NAME``, of episodes from rho_0."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcg_jax.config.arguments import output_file, run_command
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.report.scene import RenderError, no_gl, render_still
from rcg_jax.report.video import record_episodes, write_video

if TYPE_CHECKING:  # these import mujoco, which fails where MUJOCO_GL asks for a library that is not installed
    from rcg_jax.runs.load import Trained


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


def _render(options: RenderOptions, _: Sequence[str]) -> None:
    size: dict[str, Any] = {"width": options.width, "height": options.height}
    for name, pixels in size.items():
        if pixels % 2:
            raise ConfigError(f"{name}={pixels}: must be even, mp4 needs that")
    if options.task and not options.policy:
        raise ConfigError(f"task={options.task}: only with policy=...; a run knows its task")
    default = Path(f"{Path(options.policy).stem}.mp4") if options.policy else Path(options.run) / "rollouts.mp4"
    out = output_file(options.out, ".mp4") or default
    try:
        from rcg_jax.physics.jit import enable_compilation_cache
        from rcg_jax.runs.load import LoadedRun, load_policy_with_task, load_run
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
    model, camera = run.task.model, options.camera
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera not in (*cameras, "free"):
        known = f"it has {', '.join(cameras)}" if cameras else "it has none"
        print(f"camera={camera}: not in the model ({known}); using the free camera", file=sys.stderr)
    # Before the simulation: where nothing can be drawn, that is said at once.
    render_still(run.task, run.task.goal_state, **size)
    mean = options.actions == "mean"
    recordings = record_episodes(run, episodes=options.episodes, seed=options.seed, deterministic=mean)
    number = write_video(run.task, recordings, out, fps=options.fps, speed=options.speed, camera=camera, **size)
    good = sum(one.success for one in recordings)
    duration = f"{number / options.fps:.0f} s, iteration {run.iteration}"
    print(f"{out}: {good} of {len(recordings)} episodes reached the goal, {duration}")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    refusals = (ConfigError, StartsFileError, RenderError)
    return run_command(RenderOptions, "rcg_jax.render", argv, _render, instead=("policy",), refusals=refusals)


if __name__ == "__main__":
    sys.exit(main())
