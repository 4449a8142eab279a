"""Videos of a run, single pictures, and what is said where nothing can be drawn."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax import render
from rcg_jax.physics.jit import jit
from rcg_jax.report import video
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.runs.load import LoadedRun, load_run
from rcg_jax.types import sample_starts


@pytest.fixture(scope="module")
def loaded(saved: Path) -> LoadedRun:
    return load_run(saved)


@pytest.mark.parametrize(("deterministic", "repeat"), [(True, 1), (False, 3)])
def test_recordings_are_the_episodes_of_the_evaluation(loaded: LoadedRun, deterministic: bool, repeat: int) -> None:
    held = dataclasses.replace(loaded.config.policy, action_repeat=repeat)
    config = dataclasses.replace(loaded.config, policy=held)
    policy = make_policy(config, loaded.task.action_dim, repeat)
    loaded = dataclasses.replace(loaded, config=config, pi=policy)
    recordings = video.record_episodes(loaded, episodes=40, seed=3, deterministic=deterministic)

    start_key, noise_key = jax.random.split(jax.random.key(3))
    starts = sample_starts(start_key, loaded.task.feasible_starts(), 40)
    episodes = jit(
        lambda: run_episodes(
            loaded.task, policy, loaded.state.agent, noise_key, starts, deterministic=jnp.full(40, deterministic)
        )
    )()
    success = np.array([one.success for one in recordings])
    assert 0 < success.sum() < 40
    np.testing.assert_array_equal(success, episodes.success)
    np.testing.assert_array_equal([len(one.qpos) - 1 for one in recordings], episodes.length)
    for one, qpos in zip(recordings, starts.qpos, strict=True):
        np.testing.assert_array_equal(one.qpos[0], qpos)
        # The goal ends an episode: only its last state may be there.
        assert (one.distance[-1] < 0.1) == one.success
        assert np.all(one.distance[:-1] >= 0.1)


@pytest.mark.slow
@pytest.mark.usefixtures("gl")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # reading the video back
def test_video(saved: Path, loaded: LoadedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new.mp4"
    argv = ["episodes=6", "fps=10", "width=200", "height=150", "camera=nice", "seed=1"]
    assert render.main([f"run={saved}", f"out={out}", *argv]) == 0
    said = capsys.readouterr()
    assert "camera=nice: not in the model (it has none); using the free camera" in said.err

    recordings = video.record_episodes(loaded, episodes=6, seed=1, deterministic=False)
    good = sum(one.success for one in recordings)
    assert 0 < good < 6
    assert f"{out}: {good} of 6 episodes reached the goal" in said.out

    with imageio.get_reader(out) as reader:
        pictures = list(reader.iter_data())
        assert reader.get_meta_data()["fps"] == 10
    assert {picture.shape for picture in pictures} == {(150, 200, 3)}
    # 10 pictures per second of the simulation's time, the last state for 0.6 s.
    lengths = [int(np.ceil((len(one.qpos) - 1) * 0.02 * 10)) + 6 for one in recordings]
    assert abs(len(pictures) - sum(lengths)) <= len(lengths)
    assert list(tmp_path.iterdir()) == [out]


def test_where_nothing_can_be_drawn_one_line_names_the_packages(tmp_path: Path) -> None:
    """With a PyOpenGL that fails as the real one does without libEGL: importing mujoco already does."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text(
        "raise AttributeError(\"'NoneType' object has no attribute 'eglQueryString'\")"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])]), "MUJOCO_GL": "egl"}
    done = subprocess.run(
        [sys.executable, "-m", "rcg_jax.render", f"run={tmp_path}"], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: no OpenGL context")
    assert "libegl1 libegl-mesa0 libgl1-mesa-dri: make apt" in line
    assert not (tmp_path / "rollouts.mp4").exists()
