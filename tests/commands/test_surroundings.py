"""What a program meets outside of it: other JAX settings, no home, closed outputs, notebooks, hostile files."""

import io
import pickle
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import make_task, register_task, sample_nearby
from rcg_jax.config.class_path import resolve_name
from rcg_jax.io.console import lenient_output
from rcg_jax.io.npz import load_npz
from rcg_jax.physics import jit as compile
from rcg_jax.physics.silence import silence
from rcg_jax.runs.program import jax_settings_kept
from rcg_jax.runs.progress import Reporter
from rcg_jax.tasks import TASKS, PointMaze
from tests.real_run import ROOT, TINY


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_a_program_with_float64_on_gets_float32(engine):
    def near():
        task = make_task("point_maze", engine=engine)
        goal = task.goal_starts()
        starts = sample_nearby(task, jax.random.key(0), goal, num_new=8, num_candidates=200, brownian_horizon=10)
        moved = jax.jit(lambda s: task.step(s, jnp.zeros((8, 2))))(task.reset(starts))
        return starts, moved

    as_usual = near()
    with jax.enable_x64(True):
        found = near()
    jax.tree.map(np.testing.assert_array_equal, found[0], as_usual[0])
    assert {x.dtype for x in jax.tree.leaves(found)} == {np.dtype(np.float32), np.dtype(bool)}


@pytest.mark.parametrize("how", ["no home", "read-only"])
def test_a_cache_is_optional(how, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    def home():
        if how == "no home":
            raise RuntimeError("Could not determine home directory.")
        return Path("/proc")  # nobody can make folders there

    monkeypatch.setattr(Path, "home", home)
    with jax_settings_kept():
        jax.config.update("jax_compilation_cache_dir", None)
        assert compile.enable_compilation_cache() is None
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        folder = compile.enable_compilation_cache()
        assert folder is not None
        assert folder.is_relative_to(tmp_path)


class Full(io.StringIO):
    encoding = "ascii"

    def write(self, text):
        text.encode("ascii")
        raise OSError(28, "No space left on device")


def test_output_never_raises(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Full())
    monkeypatch.setattr(sys, "stderr", None)
    with lenient_output():
        print("für", flush=True)
        print("für", file=sys.stderr)
    ascii_only = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    report = Reporter(ascii_only, ascii_only)
    report.say("rüm")
    ascii_only.flush()
    assert ascii_only.buffer.getvalue() == b"r\\xfcm\n"


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&- 2>&-", "> /dev/full"])
def test_a_run_survives_its_output(closed, tmp_path):
    words = [
        "task=point_maze",
        "engine=native",
        "iterations=1",
        "trpo.iterations=1",
        "rollout.num_envs=4",
        f"run_dir={tmp_path}",
    ]
    command = shlex.join([sys.executable, "-m", "rcg_jax.run", *TINY, *words])
    assert subprocess.run(["bash", "-c", f"{command} {closed}"], check=False, cwd=ROOT).returncode == 0
    assert (tmp_path / "point_maze/reverse/seed0/policy.npz").exists()


def test_a_class_that_is_defined_again_takes_its_place(monkeypatch):
    monkeypatch.setattr("rcg_jax.tasks.TASKS", dict(TASKS))
    from rcg_jax import tasks

    def define():
        class Mine(PointMaze):
            name = "mine"

        return register_task(Mine)

    define()
    again = define()
    assert tasks.TASKS["mine"] is again
    assert resolve_name("task", "mine") == "mine"

    class Other(PointMaze):
        name = "mine"

    with pytest.raises(ValueError, match="already registered"):
        register_task(Other)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_a_task_can_be_pickled(engine):
    task = make_task("point_maze", engine=engine)
    task.neutral_action(jnp.zeros((1, 2)))
    other = pickle.loads(pickle.dumps(task))
    step = [
        jax.jit(lambda each=each: each.step(each.reset(each.goal_starts()), jnp.ones((1, 2))))()
        for each in (task, other)
    ]
    jax.tree.map(np.testing.assert_array_equal, *step)


def test_what_would_unpack_to_gigabytes_is_refused_before():
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**9,)})
    honest, lying = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(honest, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", header.getvalue() + bytes(10**8))
    with zipfile.ZipFile(lying, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", header.getvalue())
    for file in (honest, lying):
        with pytest.raises(ValueError, match=r"unpacked it would take [\d,]+ bytes"):
            load_npz(file.getvalue(), 10**6)


def test_hidden_state_is_refused_without_a_check_of_the_task():
    class Delayed(PointMaze):
        def make_spec(self):
            spec = super().make_spec()
            spec.actuators[0].delay, spec.actuators[0].nsample = 0.04, 3
            return spec

        def make_model(self):
            return self.make_spec().compile()

    task = Delayed("native")
    with pytest.raises(NotImplementedError, match=r"a history .* of actuator"):
        sample_nearby(task, jax.random.key(0), task.goal_starts(), num_new=8, num_candidates=20, brownian_horizon=10)


def test_silence_of_several_threads_ends():
    first, second = silence(), silence()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not mujoco.MjLogConfig.get().logto_console
    second.__exit__(None, None, None)
    assert mujoco.MjLogConfig.get().logto_console
