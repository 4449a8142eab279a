"""Several processes that train one run together: one writer, one end, and the curve of one process."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rcg_jax.config.settings import ConfigError, HostsConfig
from rcg_jax.io.tables import read_csv
from rcg_jax.runs.checkpoint import iterations
from rcg_jax.sharding.hosts import ALONE, connect, number_of_processes
from tests.real_run import metrics, wait_for_rows

ROOT = Path(__file__).parents[2]
SEED = Path("ring_peg", "reverse", "seed0")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])


def start(module: str, run_dir: Path, *settings: str, delay: float = 0.0) -> list[subprocess.Popen[str]]:
    """Two processes of ``module`` that train together."""
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "FAKE_DELAY": str(delay)}
    command = [sys.executable, "-m", module, *settings, f"run_dir='{run_dir}'", "hosts.processes=2"]
    address = f"hosts.coordinator=localhost:{free_port()}"
    return [
        subprocess.Popen(
            [*command, address, f"hosts.process={k}"],
            cwd=ROOT,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(2)
    ]


def end(processes: list[subprocess.Popen[str]]) -> tuple[list[int], list[str], list[str]]:
    """Exit codes, outputs, errors."""
    texts = [process.communicate(timeout=600) for process in processes]
    return [process.returncode for process in processes], [out for out, _ in texts], [err for _, err in texts]


FAKE = ("iterations=12", "checkpoint_every=2", "eval_every=0", "evaluation.final_episodes=20")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two processes that nothing happened to."""
    run_dir = tmp_path_factory.mktemp("whole")
    codes, outs, errs = end(start("tests.fake_run", run_dir, *FAKE))
    assert codes == [0, 0], errs
    assert "iteration 12/12" in outs[0]
    assert "iteration" not in outs[1]
    return run_dir


@pytest.mark.slow
def test_one_process_writes_each_row_once(whole: Path) -> None:
    assert [row[0] for row in metrics(whole / SEED)] == [str(k) for k in range(1, 13)]
    assert iterations(whole / SEED / "checkpoints") == [8, 10, 12]
    assert [row[0] for row in read_csv(whole / SEED / "eval.csv")[1]] == ["12"]
    assert [row[0] for row in read_csv(whole / SEED / "starts.csv")[1]] == [str(k) for k in range(1, 13)]
    assert len(read_csv(whole / SEED / "final_evaluation.csv")[1]) == 20
    assert all((whole / SEED / name).exists() for name in ("policy.npz", "picture.png", "report.html"))
    assert len(list((whole / SEED / "tensorboard").iterdir())) == 1


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_run_which_resumes(tmp_path: Path, whole: Path, victim: int) -> None:
    processes = start("tests.fake_run", tmp_path, *FAKE, delay=0.2)
    wait_for_rows(processes, tmp_path / SEED, 3)
    processes[victim].kill()
    codes, _, errs = end(processes)
    assert codes[victim] == -signal.SIGKILL
    assert codes[1 - victim] not in (0, None)
    # Ours where a collective fails, JAX's own where its service notices first.
    assert "another process has ended" in errs[1 - victim] or "another task died" in errs[1 - victim]
    assert len(metrics(tmp_path / SEED)) < 12
    codes, outs, errs = end(start("tests.fake_run", tmp_path, *FAKE))
    assert codes == [0, 0], errs
    assert "resuming from iteration" in outs[0]
    assert metrics(tmp_path / SEED) == metrics(whole / SEED)


@pytest.mark.slow
def test_all_stop_and_save_where_one_is_asked_to(tmp_path: Path, whole: Path) -> None:
    processes = start("tests.fake_run", tmp_path, *FAKE, delay=0.2)
    wait_for_rows(processes, tmp_path / SEED, 3)
    processes[1].send_signal(signal.SIGTERM)
    codes, outs, errs = end(processes)
    assert codes == [143, 143], errs
    assert "stopped by SIGTERM, saved at iteration" in outs[0]
    done = len(metrics(tmp_path / SEED))
    assert 3 <= done < 12
    assert iterations(tmp_path / SEED / "checkpoints")[-1] == done
    # One process can go on with what two began.
    alone = [sys.executable, "-m", "tests.fake_run", *FAKE, f"run_dir='{tmp_path}'"]
    subprocess.run(alone, cwd=ROOT, check=True, capture_output=True, timeout=600)
    assert metrics(tmp_path / SEED) == metrics(whole / SEED)


@pytest.mark.slow
def test_two_processes_train_as_one_does(tmp_path: Path) -> None:
    settings = ("0", "devices=2", "iterations=1", "trpo.iterations=1", "rollout.batch_size=2000")
    codes, _, errs = end(start("tests.line_run", tmp_path / "two", *settings))
    assert codes == [0, 0], errs
    one = [sys.executable, "-m", "tests.line_run", *settings, f"run_dir='{tmp_path / 'one'}'"]
    subprocess.run(one, cwd=ROOT, check=True, capture_output=True, timeout=600)
    values = [np.array(metrics(tmp_path / name / SEED), float) for name in ("one", "two")]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-4, atol=1e-6)


def test_a_process_alone_needs_nothing() -> None:
    assert connect(HostsConfig()) is ALONE
    assert ALONE.is_first
    assert ALONE.any_signal(15) == 15
    assert ALONE.any_signal(None) is None


def test_the_number_of_processes_is_slurms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    with pytest.raises(ConfigError, match=r"coordinator=slurm: SLURM_JOB_ID is not set; start the processes with srun"):
        number_of_processes(HostsConfig(coordinator="slurm"))
    environment = {"JOB_ID": "7", "NTASKS": "3", "PROCID": "1", "LOCALID": "0", "STEP_NODELIST": "node[1-3]"}
    for name, value in environment.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert number_of_processes(HostsConfig(coordinator="slurm")) == 3
    # Inside a job, but not asked for: a sweep's members are alone.
    assert number_of_processes(HostsConfig()) == 1
