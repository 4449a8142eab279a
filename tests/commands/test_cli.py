"""The command line as a user meets it: help, refusals, Hydra's own options, sweeps."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rcg_jax.cli import sweep
from rcg_jax.config import compose as cli
from rcg_jax.config.presets import PRESETS
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.runs.checkpoint import iterations

ROOT = Path(__file__).parents[2]

SMALL = ("iterations=2", "evaluation.episodes=4", "evaluation.final_episodes=5")


def test_help_names_every_field_with_all_that_is_known_of_it() -> None:
    text = " ".join(cli.help_text().split())
    for name, item, _ in flatten(Config()):
        assert len(item.metadata["help"]) > 10, name
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


def test_help_and_refusals_come_at_once_as_a_program() -> None:
    """JAX, whose import takes seconds, is not imported; and ``--help | head`` is no error."""
    code = (
        "import sys; from rcg_jax import run; codes = [run.main([x]) for x in ('task=none.py:X', 'seed=x', '-h')]; "
        "print(*codes, 'jax' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert "usage: python -m rcg_jax.run" in done.stdout
    assert [line[:7] for line in done.stderr.splitlines()[:2]] == ["error: ", "error: "]
    assert done.stderr.splitlines()[2:] == ["2 2 0 False"]
    closed = subprocess.Popen(
        [sys.executable, "-m", "rcg_jax.run", "--help"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert closed.stdout is not None
    assert closed.stderr is not None
    closed.stdout.close()
    assert closed.stderr.read() == b""
    closed.wait(60)


@pytest.mark.parametrize(
    "words",
    [
        ("task=maze",),
        ("--frobnicate",),
        ("-m", "seed=0,1", "trpo.max_kl=0.01,-1"),
        ("-m", "task=ring_peg,maze"),
        ("--cfg", "job", "seed=x"),
    ],
)
def test_a_refusal_is_one_line_exit_2_and_leaves_nothing(tmp_path: Path, command: Callable, words: tuple[str]) -> None:
    done = command(*words)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert done.err.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_hydra_shows_the_configuration(tmp_path: Path, command: Callable) -> None:
    done = command("--cfg", "job", "preset=paper", "seed=7")
    assert done.code == 0, done.err
    assert "seed: 7" in done.out
    assert "batch: episodes" in done.out
    assert list(tmp_path.iterdir()) == []


def test_a_sweep_composes_every_member_in_hydras_order() -> None:
    members = sweep.check(["method=reverse,uniform", "seed=range(0,2)", "preset=paper"])
    found = [(config.method, config.seed) for _, config in members]
    assert found == [("reverse", 0), ("reverse", 1), ("uniform", 0), ("uniform", 1)]
    assert all(config.rollout.batch == "episodes" for _, config in members)
    members = sweep.check(sweep.with_own_folders(["preset=default,paper"]))
    assert [config.iterations for _, config in members] == [200, 2000]


def test_members_that_the_path_does_not_tell_apart_get_folders_of_their_own() -> None:
    overrides = sweep.with_own_folders(["trpo.max_kl=0.01,0.02", "seed=0,1", "run_dir=some/where"])
    folders = {(config.run_dir, config.seed) for _, config in sweep.check(overrides)}
    assert folders == {(f"some/where/trpo.max_kl-{kl}", seed) for kl in (0.01, 0.02) for seed in (0, 1)}


def test_members_that_cannot_run_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="seed1"):
        sweep.check(["seed=0,1", "num_seeds=2"])
    with pytest.raises(ConfigError, match=r"trpo\.max_kl=-1.*member 1"):
        sweep.check(["trpo.max_kl=0.1,-1"])


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_leaves_only_its_own_folder_which_other_settings_leave_alone(tmp_path: Path, command: Callable) -> None:
    done = command(*SMALL)
    assert (done.code, done.err) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert iterations(tmp_path / "runs" / "ring_peg" / "reverse" / "seed0" / "checkpoints") == [2]
    before = files(tmp_path)
    done = command(*SMALL, "trpo.gamma=0.9")
    assert (done.code, len(done.err.splitlines())) == (2, 1)
    assert "trpo.gamma 0.998 -> 0.9" in done.err
    assert before == files(tmp_path)


def test_a_failed_member_does_not_stop_a_sweep(tmp_path: Path, command: Callable) -> None:
    done = command("-m", "method=uniform,reverse", "seed=0,1", *SMALL)
    assert done.code == 1
    assert "2 of 4 runs finished" in done.out
    assert done.out.count("resume with: python -m rcg_jax.run method=uniform") == 2
    assert done.out.count("failed: exit code 1, see above") == 2
    assert done.err.count("something unforeseen") >= 2
    for seed in ("seed0", "seed1"):
        assert iterations(tmp_path / "runs" / "ring_peg" / "reverse" / seed / "checkpoints") == [2]
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_sweep_over_any_field_runs_and_resumes(tmp_path: Path, command: Callable) -> None:
    """Also member by member, and where the folder's name needs quoting."""
    words = ("-m", "policy.hidden=[8,8],[16]", "trpo.max_kl=0.01", "run_dir='my runs'", *SMALL)
    assert command(*words).code == 0
    for value in ("[8,8]", "[16]"):
        folder = tmp_path / "my runs" / f"policy.hidden-{value.replace(',', ', ')}" / "ring_peg" / "reverse" / "seed0"
        assert iterations(folder / "checkpoints") == [2]
    outcomes = [json.loads(path.read_text()) for path in tmp_path.rglob("outcome.json")]
    assert {outcome["settings"][0] for outcome in outcomes} == {"policy.hidden=[8,8]", "policy.hidden=[16]"}
    for outcome in outcomes:
        assert "the run is complete: 2 of 2" in command(*outcome["settings"]).out
    assert command(*words).out.count("the run is complete: 2 of 2") == 2


def test_an_interrupted_member_ends_the_sweep(tmp_path: Path, command: Callable) -> None:
    done = command("-m", "method=all_starts,reverse", *SMALL)
    assert done.code == 143, done.err
    assert not (tmp_path / "runs" / "ring_peg" / "reverse").exists()
