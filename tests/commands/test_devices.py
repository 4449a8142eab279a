"""Environments and seeds over several devices: the results of one device, without waiting for each other."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.runs.settings import differences, is_free, read_config

ROOT = Path(__file__).parents[2]

#: Runs in a process of its own, because the number of CPU devices is fixed at its first computation.
SCRIPT = """
import sys, numpy as np, jax
from rcg_jax.physics.jit import enable_compilation_cache
from tests.line_run import first_iteration, rollout_program
enable_compilation_cache()
open(f"{sys.argv[1]}/rollout.txt", "w").write(rollout_program("4"))
whole = "rollout.batch=episodes"
for name, devices, seeds, *more in (
    ("one", "1", 1), ("four", "4", 1),
    ("one_whole", "1", 1, whole), ("four_whole", "4", 1, whole), ("seeds_whole", "4", 2, whole),
):
    leaves = jax.tree_util.tree_flatten_with_path(first_iteration(devices, seeds, *more))[0]
    np.savez(f"{sys.argv[1]}/{name}.npz", **{jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves})
"""

_COLLECTIVE = re.compile(r"\b(all-reduce|all-gather|all-to-all|collective-permute)(-start)?\(")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("devices")
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)], cwd=ROOT, env=env, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    return folder


def read(folder: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(folder / f"{name}.npz") as file:
        return dict(file)


def assert_agree(got: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    """The first iteration: what was simulated and labelled exactly, what was learned to rounding."""
    assert any(".labels" in name for name in wanted)
    for name in wanted:
        if np.issubdtype(wanted[name].dtype, np.floating):
            np.testing.assert_allclose(got[name], wanted[name], rtol=1e-3, atol=1e-5, err_msg=name)
        else:
            np.testing.assert_array_equal(got[name], wanted[name], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("batch", ["", "_whole"])
def test_four_devices_compute_what_one_does(results: Path, batch: str) -> None:
    one, four = read(results, f"one{batch}"), read(results, f"four{batch}")
    # The policy has moved, as far as the trust region allows, and by an accepted step.
    assert one["[1].accepted"] == 1
    assert one["[1].kl"] > 1e-3
    assert one["[0].labels.episodes"].sum() > 0
    assert_agree(four, one)


@pytest.mark.slow
def test_seeds_and_environments_share_four_devices(results: Path) -> None:
    one, both = read(results, "one_whole"), read(results, "seeds_whole")
    assert_agree({name: leaf[0] for name, leaf in both.items()}, one)
    first, second = both["[0].labels.successes"]
    assert (first != second).any()


@pytest.mark.slow
def test_devices_do_not_wait_for_each_other_in_a_rollout(results: Path) -> None:
    text = (results / "rollout.txt").read_text()
    # Each has a quarter of the 40 environments.
    assert "num_partitions=4" in text
    assert "f32[30,10,2]" in text
    assert not _COLLECTIVE.findall(text)


MAZE = Config(task="point_maze")


def test_a_run_may_go_on_elsewhere() -> None:
    assert is_free("devices")
    assert is_free("hosts.process")
    assert is_free("matmul_precision")
    earlier = {name: value for name, _, value in flatten(MAZE) if name != "matmul_precision"}
    assert not differences(earlier, MAZE), "a run of before there was this setting goes on"


def test_a_setting_that_a_folder_does_not_have_is_one_that_differs(tmp_path: Path) -> None:
    """Nobody knows what the run was trained with."""
    earlier = {name: value for name, _, value in flatten(MAZE) if name != "curriculum.stall_walk"}
    assert differences(earlier, MAZE) == ["curriculum.stall_walk (absent) -> 0"]
    earlier |= {"curriculum.stall_walk": 0, "trpo.mastered_failures": 0.1}
    assert differences(earlier, MAZE) == ["trpo.mastered_failures 0.1 -> (absent)"]
    younger = {name: value for name, _, value in flatten(MAZE) if not name.startswith(("algorithm", "ppo."))}
    assert not differences(younger, MAZE)  # these do what was done before there were any
    assert differences(younger, dataclasses.replace(MAZE, algorithm="ppo")) == ["algorithm trpo -> ppo"]
    (tmp_path / "config.yaml").write_text("trpo:\n  mastered_failures: 0.1\n")
    with pytest.raises(ConfigError, match=rf"{tmp_path}/config\.yaml: .*mastered_failures"):
        read_config(tmp_path)


def run_line(run_dir: Path, *settings: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.line_run", "0", f"run_dir='{run_dir}'", *settings]
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900)
    return {"code": done.returncode, "out": done.stdout, "err": done.stderr}


@pytest.mark.slow
def test_checkpoints_know_nothing_of_devices(tmp_path: Path) -> None:
    first = run_line(tmp_path, "devices=4", "iterations=1")
    assert first["code"] == 0, first["err"]
    second = run_line(tmp_path, "devices=1", "iterations=2")
    assert second["code"] == 0, second["err"]
    assert "resuming from iteration 1 of 2" in second["out"]


@pytest.mark.slow
def test_environments_that_cannot_be_shared_are_refused(tmp_path: Path) -> None:
    refused = run_line(tmp_path, "devices=3")
    assert refused["code"] == 2
    assert "devices=3: rollout.num_envs=40 environments must be a multiple of 3" in refused["err"]
    assert not list(tmp_path.iterdir())


THREADS = """
import os, sys
from pathlib import Path
from rcg_jax.config.compose import compose_config
from rcg_jax.runs.program import load_program
load_program(compose_config(sys.argv[1:]))
import jax, jax.numpy as jnp
jax.jit(lambda x: x @ x)(jnp.ones((9, 9))).block_until_ready()
names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
print(sum("XLAEigen" in name for name in names), "NPROC" in os.environ)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in Linux's /proc")
@pytest.mark.skipif(len(getattr(os, "sched_getaffinity", lambda _: [0])(0)) < 2, reason="one core cannot be halved")
def test_native_physics_leaves_half_of_the_cores_alone_but_not_with_several_seeds() -> None:
    """XLA's threads, counted in processes of their own; the variable they are set by is not left to others."""
    cores = len(os.sched_getaffinity(0))
    env = {name: value for name, value in os.environ.items() if name != "NPROC"}

    def threads(*settings: str) -> tuple[int, str]:
        command = [sys.executable, "-c", THREADS, "task=point_maze", "engine=native", *settings]
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        number, left = done.stdout.split()
        return int(number), left

    assert threads() == (cores // 2, "False")
    assert threads("num_seeds=2") == (cores, "False")
