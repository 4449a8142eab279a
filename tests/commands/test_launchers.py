"""Sweeps through Hydra's launchers: side by side on this machine, and through Slurm, which is played here."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rcg_jax.cli import sweep
from rcg_jax.config import compose as cli
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.tables import read_csv

TINY = (
    "task=point_maze",
    "engine=native",
    "iterations=2",
    "eval_every=0",
    "write_report=false",
    "rollout.num_envs=20",
    "rollout.batch_size=2000",
    "evaluation.final_episodes=4",
    "curriculum.num_candidates=200",
    "baseline.minibatch_size=500",
    "policy.hidden=[4]",
    "baseline.hidden=[4]",
)


def test_launchers_that_are_not_there_are_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert sweep.check_launcher(["task=ring_peg", "seed=0,1"]) == "basic"
    assert sweep.check_launcher(["hydra/launcher=joblib"]) == "joblib"
    monkeypatch.setattr(sweep, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'submitit_local: is not installed; pip install "rcg_jax\[launchers\]"'):
        sweep.check_launcher(["hydra/launcher=submitit_local"])
    monkeypatch.setattr(sweep, "find_spec", lambda name: name)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ConfigError, match="hydra/launcher=submitit_slurm: no sbatch here"):
        sweep.check_launcher(["hydra/launcher=submitit_slurm"])
    assert sweep.check_launcher(["hydra/launcher=submitit_local"]) == "submitit_local"
    assert sweep.check_launcher(["hydra/launcher=basic"]) == "basic"
    with pytest.raises(ConfigError, match=r"hydra/launcher=slurm: must be one of basic, joblib, .*submitit_slurm$"):
        sweep.check_launcher(["hydra/launcher=slurm"])


def test_a_launcher_needs_a_sweep() -> None:
    with pytest.raises(ConfigError, match="hydra/launcher=joblib: is about the runs of a sweep; needs -m"):
        cli.compose_config(["hydra/launcher=joblib", "seed=0"])


def command(folder: Path, *words: str) -> list[str]:
    return [sys.executable, "-m", "rcg_jax.run", "-m", *TINY, f"run_dir={folder}", *words]


@pytest.mark.slow
def test_joblib_runs_members_side_by_side_and_one_that_fails_leaves_the_other_alone(tmp_path: Path) -> None:
    # A folder that another kind of file occupies: this member cannot be written.
    (tmp_path / "point_maze").mkdir()
    (tmp_path / "point_maze" / "reverse").write_text("in the way")
    words = command(tmp_path, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "method=uniform,reverse")
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "sweep: 1 of 2 runs finished" in done.stdout
    assert "failed: exit code 2, see above" in done.stdout
    assert "error: " in done.stderr
    assert "resume with: python -m rcg_jax.run" in done.stdout
    assert "[0] iteration 2/2" in done.stdout
    assert (tmp_path / "point_maze" / "uniform" / "seed0" / "checkpoints" / "2").is_dir()


@pytest.mark.slow
def test_a_sweep_that_is_terminated_takes_its_members_along(tmp_path: Path) -> None:
    """Sent to the sweep's own process alone; its members save and end."""
    words = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "iterations=100000", "method=uniform", "seed=0,1")
    sweep = subprocess.Popen(command(tmp_path, *words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    members = [tmp_path / "point_maze" / "uniform" / f"seed{seed}" for seed in (0, 1)]
    deadline = time.monotonic() + 300
    while not all(read_csv(member / "metrics.csv")[1] for member in members):
        assert sweep.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    sweep.terminate()
    out, _ = sweep.communicate(timeout=300)
    assert sweep.returncode == 143, out
    assert "sweep: 0 of 2 runs finished" in out
    assert out.count("\nstopped by SIGTERM\n  resume with: ") == 2
    for member in members:
        assert (member / "checkpoints" / str(len(read_csv(member / "metrics.csv")[1]))).is_dir()


SBATCH = """#!{python}
import os, re, subprocess, sys
script = open(sys.argv[-1]).read()
open("{folder}/submitted.sh", "w").write(script)
count = int(re.search(r"--array=0-(\\d+)", script).group(1)) + 1
for task in range(count):
    env = dict(os.environ, SLURM_JOB_ID=f"7{{task}}", SLURM_ARRAY_JOB_ID="7", SLURM_ARRAY_TASK_ID=str(task),
               SLURM_NTASKS="1", SLURM_JOB_NUM_NODES="1", SLURM_NODEID="0", SLURM_PROCID="0", SLURM_LOCALID="0")
    log = open(f"{folder}/slurm{{task}}.log", "w")
    subprocess.Popen(["bash", sys.argv[-1]], env=env, stdout=log, stderr=log, start_new_session=True)
print("Submitted batch job 7")
"""

#: Runs what follows its options; submitit gives the command last.
SRUN = """#!/bin/bash
while [[ "$1" == --* ]]; do
  case "$1" in --*=*) shift ;; --output|--error) shift 2 ;; *) shift ;; esac
done
exec "$@"
"""

SACCT = """#!/bin/bash
echo 'JobID|State|NodeList|'
"""


def executable(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.mark.slow
def test_slurm_gets_one_array_job_whose_members_run_and_report(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    programs = tmp_path / "bin"
    programs.mkdir()
    executable(programs / "sbatch", SBATCH.format(python=sys.executable, folder=tmp_path))
    executable(programs / "srun", SRUN)
    executable(programs / "sacct", SACCT)
    words = command(
        tmp_path / "runs",
        "hydra/launcher=submitit_slurm",
        "hydra.launcher.partition=gpu",
        "hydra.launcher.gres=gpu:1",
        "hydra.launcher.timeout_min=45",
        "method=uniform",
        "seed=0,1",
    )
    env = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=env)
    logs = "".join(path.read_text() for path in sorted(tmp_path.glob("slurm*.log")))
    assert done.returncode == 0, done.stdout + done.stderr + logs
    assert "sweep: 2 of 2 runs finished" in done.stdout
    script = (tmp_path / "submitted.sh").read_text()
    for line in ("--partition=gpu", "--gres=gpu:1", "--time=45", "--array=0-1"):
        assert f"#SBATCH {line}" in script
    for seed in (0, 1):
        assert (tmp_path / "runs" / "point_maze" / "uniform" / f"seed{seed}" / "checkpoints" / "2").is_dir()
    outcomes = [json.loads(path.read_text()) for path in (tmp_path / "runs").rglob("outcome.json")]
    assert [outcome["code"] for outcome in outcomes] == [0, 0]


@pytest.mark.parametrize("jobs", ["0", "-2", "two"])
def test_a_number_of_jobs_that_cannot_be_is_refused(jobs: str) -> None:
    with pytest.raises(ConfigError, match=rf"hydra\.launcher\.n_jobs={jobs}: must be an integer >= 1, or -1"):
        sweep.run_sweep(cli.parse(["-m", "seed=0,1", "hydra/launcher=joblib", f"hydra.launcher.n_jobs={jobs}"]))
