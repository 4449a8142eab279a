"""The command line as a user meets it: help, refusals, Hydra's own options, sweeps."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rcg_jax.cli import sweep
from rcg_jax.config import compose as cli
from rcg_jax.config.presets import PRESETS
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.runs.checkpoint import iterations

ROOT = Path(__file__).parents[2]


def command(*args: str, cwd: Path = ROOT, module: str = "rcg_jax.run") -> subprocess.CompletedProcess[str]:
    paths = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    return subprocess.run(
        [sys.executable, "-m", module, *args], cwd=cwd, env=paths, capture_output=True, text=True, timeout=60
    )


def test_help_names_every_field_with_all_that_is_known_of_it() -> None:
    text = " ".join(cli.help_text().split())
    for name, item, _ in flatten(Config()):
        assert f" {name}=" in text, name
        for key in ("help", "unit", "symbol"):
            assert " ".join(item.metadata[key].split()) in text, (name, key)
        for choice in item.metadata["choices"]:
            assert choice in text, (name, choice)
        for bound in ("low", "high", "above"):
            if item.metadata[bound] is not None:
                assert f"{item.metadata[bound]:.10g}" in text, (name, bound)
    for name, value in PRESETS["paper"].items():
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        assert f"{name}={shown.lower() if isinstance(value, bool) else shown}" in text


def test_help_and_refusals_come_without_importing_jax() -> None:
    code = (
        "import sys; from rcg_jax import run; run.main(['--help']); run.main(['seed=x']); print('jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "False"


def test_help_exits_0() -> None:
    start = time.monotonic()
    done = command("--help")
    assert done.returncode == 0, done.stderr
    assert "usage: python -m rcg_jax.run" in done.stdout
    assert done.stderr == ""
    assert time.monotonic() - start < 10  # a fraction of a second; a busy machine is not the subject here


@pytest.mark.parametrize(
    "args",
    [
        ("task=maze",),
        ("tsk=ring_peg",),
        ("iterations=abc",),
        ("trpo.max_kl=-1",),
        ("--frobnicate",),
        ("-m", "seed=0,1", "trpo.max_kl=0.01,-1"),
        ("-m", "task=ring_peg,maze"),
        ("--cfg", "job", "seed=x"),
    ],
)
def test_a_refusal_is_one_line_exit_2_and_leaves_nothing(tmp_path: Path, args: tuple[str, ...]) -> None:
    done = command(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_hydra_shows_the_configuration(tmp_path: Path) -> None:
    done = command("--cfg", "job", "preset=paper", "seed=7", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "seed: 7" in done.stdout
    assert "batch: episodes" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_sweep_expands_in_hydras_order_and_composes_every_member() -> None:
    members = sweep.check(["method=reverse,uniform", "seed=range(0,2)", "preset=paper"])
    assert [(config.method, config.seed) for _, config in members] == [
        ("reverse", 0),
        ("reverse", 1),
        ("uniform", 0),
        ("uniform", 1),
    ]
    assert all(config.rollout.batch == "episodes" for _, config in members)


def test_a_sweep_over_presets_applies_each() -> None:
    members = sweep.check(sweep.with_own_folders(["preset=default,paper"]))
    assert [config.iterations for _, config in members] == [200, 2000]


def test_members_that_the_path_does_not_tell_apart_get_folders_of_their_own() -> None:
    overrides = sweep.with_own_folders(["trpo.max_kl=0.01,0.02", "seed=0,1", "run_dir=some/where"])
    folders = {(config.run_dir, config.seed) for _, config in sweep.check(overrides)}
    assert folders == {(f"some/where/trpo.max_kl-{kl}", seed) for kl in (0.01, 0.02) for seed in (0, 1)}


def test_members_that_would_share_a_folder_are_refused() -> None:
    with pytest.raises(ConfigError, match="seed1"):
        sweep.check(["seed=0,1", "num_seeds=2"])


def test_the_error_of_a_member_names_it() -> None:
    with pytest.raises(ConfigError, match=r"trpo\.max_kl=-1.*member 1"):
        sweep.check(["trpo.max_kl=0.1,-1"])


SMALL = ["iterations=2", "evaluation.episodes=4", "evaluation.final_episodes=5"]


def fake_run(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """The command line, with a program without physics (:mod:`tests.fake_run`)."""
    return command(*args, *SMALL, cwd=folder, module="tests.fake_run")


def test_a_single_run_leaves_only_its_own_folder(tmp_path: Path) -> None:
    done = fake_run(tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert iterations(tmp_path / "runs" / "ring_peg" / "reverse" / "seed0" / "checkpoints") == [2]


def test_changed_settings_exit_2_without_touching_the_run(tmp_path: Path) -> None:
    assert fake_run(tmp_path).returncode == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    done = fake_run(tmp_path, "trpo.gamma=0.9")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "trpo.gamma 0.998 -> 0.9" in done.stderr
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_a_failed_member_does_not_stop_a_sweep(tmp_path: Path) -> None:
    done = fake_run(tmp_path, "-m", "method=uniform,reverse", "seed=0,1")
    assert done.returncode == 1
    assert "2 of 4 runs finished" in done.stdout
    assert done.stdout.count("resume with: python -m rcg_jax.run method=uniform") == 2
    assert done.stdout.count("failed: exit code 1, see above") == 2
    assert done.stderr.count("something unforeseen") >= 2
    for seed in ("seed0", "seed1"):
        assert iterations(tmp_path / "runs" / "ring_peg" / "reverse" / seed / "checkpoints") == [2]
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_sweep_over_any_field_runs_and_resumes(tmp_path: Path) -> None:
    done = fake_run(tmp_path, "-m", "trpo.max_kl=0.01,0.02")
    assert done.returncode == 0, done.stderr
    for value in ("0.01", "0.02"):
        folder = tmp_path / "runs" / f"trpo.max_kl-{value}" / "ring_peg" / "reverse" / "seed0"
        assert iterations(folder / "checkpoints") == [2]
    outcomes = [json.loads(path.read_text()) for path in tmp_path.rglob("outcome.json")]
    assert {outcome["settings"][0] for outcome in outcomes} == {"trpo.max_kl=0.01", "trpo.max_kl=0.02"}
    done = fake_run(tmp_path, "-m", "trpo.max_kl=0.01,0.02")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("the run is complete: 2 of 2") == 2


def test_the_command_that_resumes_a_member_finds_its_folder(tmp_path: Path) -> None:
    """Also where the folder's name needs quoting."""
    assert fake_run(tmp_path, "-m", "policy.hidden=[8,8],[16]", "run_dir='my runs'").returncode == 0
    outcomes = [json.loads(path.read_text()) for path in tmp_path.rglob("outcome.json")]
    for outcome in outcomes:
        done = command(*outcome["settings"], cwd=tmp_path, module="tests.fake_run")
        assert done.returncode == 0, done.stderr
        assert "the run is complete: 2 of 2" in done.stdout


def test_an_interrupted_member_ends_the_sweep(tmp_path: Path) -> None:
    done = fake_run(tmp_path, "-m", "method=all_starts,reverse")
    assert done.returncode == 143, done.stderr
    assert not (tmp_path / "runs" / "ring_peg" / "reverse").exists()


def test_help_that_is_cut_short_is_no_error() -> None:
    """As in ``--help | head``: the text does not fit into the pipe that nobody reads any more."""
    done = subprocess.Popen(
        [sys.executable, "-m", "rcg_jax.run", "--help"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert done.stdout is not None
    assert done.stderr is not None
    done.stdout.close()
    assert done.stderr.read() == b""
    done.stderr.close()
    done.wait(60)
