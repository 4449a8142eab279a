"""Scaling sweeps, and what runs on a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.benchmarks import gpu_agreement, point_process, scaling
from experiments.benchmarks.scaling import ScalingOptions
from experiments.common import read
from tests import tiny_run

GPU = Path(__file__).parents[2] / "experiments" / "benchmarks" / "gpu.sh"

#: What a machine says about itself.
ABOUT = {
    "platform": "cpu",
    "count": 1,
    "horizons": {"ring_peg": 500, "point_maze": 500},
    "device": "abacus",
    "cpus": "2",
    "python": "3",
    "jax": "0",
    "mujoco": "3",
    "commit": "abc",
}

#: A point that works: its arguments are file, speed.
GOOD = """
import json, sys
n = float(sys.argv[2])
known = dict(start_s=1.0, compile_s=2.0, planned_gb=1e-4 * n, peak_gb=1.0, steps_per_s=int(1000 * n))
known |= dict(iteration_s=0.1, cpu_s=0.1, env_steps=100 * n, rounds=1, run_gb=0.1)
open(sys.argv[1], "w").write(json.dumps(known))
"""
OUT_OF_MEMORY = "print('jax.errors.JaxRuntimeError: RESOURCE_EXHAUSTED: Out of memory while trying'); exit(1)"


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[tuple[str, int]]]:
    """Replaces points by short scripts; returns the (engine, num_envs) of those that were started."""

    def install(bad: dict[tuple[str, int], str]) -> list[tuple[str, int]]:
        started: list[tuple[str, int]] = []

        def module(name: str, settings: dict[str, Any]) -> list[str]:
            key = settings["engine"], settings["num_envs"]
            started.append(key)
            return [sys.executable, "-c", bad.get(key, GOOD), str(settings["out"]), str(settings["num_envs"])]

        monkeypatch.setattr(scaling.point_process, "module", module)
        monkeypatch.setattr(point_process, "LOOK_S", 0.02)
        return started

    return install


def sweep(folder: Path, about: dict[str, Any] = ABOUT, **settings: Any) -> tuple[int, dict[tuple[str, int], str]]:
    """The exit of a sweep, and the status of each point in its CSV."""
    chosen = ScalingOptions(out=str(folder / "scaling.csv"), **settings)
    plan = scaling.points(chosen, "cpu", {"ring_peg": 500})
    failures = scaling.sweep(chosen, plan, about)
    rows = read(folder / "scaling.csv")
    return failures, {(row["engine"], int(row["num_envs"])): row["status"] for row in rows}


#: Six points.
SETTINGS: dict[str, Any] = {"engines": "native,mjx", "num_envs": "10,20,40"}


class TestSweep:
    def test_out_of_memory_is_a_row_and_the_sweep_goes_on(self, tmp_path: Path, fake: Any, capsys: Any) -> None:
        started = fake({("mjx", 20): OUT_OF_MEMORY})
        failures, status = sweep(tmp_path, **SETTINGS)
        assert failures == 0
        assert status == {
            **{("native", n): "ok" for n in (10, 20, 40)},
            ("mjx", 10): "ok",
            ("mjx", 20): "out of memory",
        }
        assert ("mjx", 40) not in started
        assert "left out, a smaller one ran out of memory" in capsys.readouterr().out
        row = next(row for row in read(tmp_path / "scaling.csv") if row["status"] == "out of memory")
        assert "RESOURCE_EXHAUSTED" in row["note"]
        assert (row["batch_size"], row["device"], row["steps_per_s"]) == ("4000", "abacus", "")

    def test_what_is_known_is_not_measured_again(self, tmp_path: Path, fake: Any) -> None:
        bad = {("mjx", 20): OUT_OF_MEMORY, ("native", 20): "exit(3)"}
        fake(bad)
        assert sweep(tmp_path, **SETTINGS)[0] == 1
        again = fake(bad)
        sweep(tmp_path, **SETTINGS)
        assert again == [("native", 20)], "only what failed for another reason than memory"
        other_commit = fake({})
        sweep(tmp_path, {**ABOUT, "commit": "def"}, **SETTINGS)
        assert len(other_commit) == 6
        forced = fake({})
        _, status = sweep(tmp_path, force="yes", **SETTINGS)
        assert len(forced) == 6
        assert status["native", 20] == "ok"
        assert len(read(tmp_path / "scaling.csv")) == 12

    def test_slow_points(self, tmp_path: Path, fake: Any) -> None:
        fake({("native", 10): "import time; time.sleep(600)"})
        failures, status = sweep(tmp_path, engines="native", num_envs="10,20", timeout=0.5)
        assert failures == 0
        assert status == {("native", 10): "timed out"}, "larger ones are left out"
        assert read(tmp_path / "scaling.csv")[0]["note"].startswith("after 0.5 s")

    def test_a_point_is_ended_before_the_machine_has_no_memory(
        self, tmp_path: Path, fake: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake({("native", 10): "import time; time.sleep(60)"})
        monkeypatch.setattr(point_process, "available_gb", lambda: 0.5)
        _, status = sweep(tmp_path, engines="native", num_envs="10")
        assert status == {("native", 10): "out of memory"}


class TestGpu:
    @pytest.mark.slow
    def test_two_sides_on_a_cpu_agree(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        tiny_run.register(tmp_path, monkeypatch)
        for side in ("cpu", "device"):
            words = (f"side={side}", f"folder={tmp_path}", "task=tiny", "num_envs=10", "length=100")
            monkeypatch.setattr(sys, "argv", ["gpu_agreement", *words])
            assert gpu_agreement.main() == 0
        sides = [dict(np.load(tmp_path / f"{side}.npz")) for side in ("cpu", "device")]
        assert np.linalg.norm(sides[0]["own_step"]) > 0
        values = {row["quantity"]: row["value"] for row in gpu_agreement.compare(*sides)}
        assert max(value for name, value in values.items() if "difference" in name) < 1e-3

    @pytest.mark.skipif(sys.platform == "win32", reason="a shell script")
    def test_a_part_that_fails_leaves_the_others_alone(self, tmp_path: Path) -> None:
        env = {**os.environ, "PYTHON": "false", "OUT": str(tmp_path), "SMALL": "1"}
        done = subprocess.run([GPU, "scaling", "bench"], env=env, capture_output=True, text=True)
        assert done.returncode == 2, "the number of failed parts"
        summary = (tmp_path / "summary.txt").read_text()
        assert "scaling: exit code 1" in summary
        assert "bench: exit code 1" in summary
