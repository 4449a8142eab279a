"""The outer loop with a training program that has no physics: resume, refuse, stop, full disks."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax.config.compose import compose_config
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.tables import read_csv
from rcg_jax.runs import checkpoint
from rcg_jax.runs import train as loop
from rcg_jax.runs.folder import FolderInUseError, RunFolder
from rcg_jax.runs.program import Program
from rcg_jax.runs.progress import Reporter
from rcg_jax.runs.settings import read_config
from rcg_jax.tasks.training import resolve
from tests.fake_program import fake_config, init, load_fake, make_evaluate
from tests.real_run import metrics, wait_for_rows

ROOT = Path(__file__).parents[2]


def train(run_dir: Path, *overrides: str) -> Path:
    loop.run(fake_config(run_dir, *overrides), report=Reporter(), command="again", load=load_fake)
    return run_dir / "ring_peg" / "reverse"


def evaluations(folder: Path) -> list[list[str]]:
    return read_csv(folder / "eval.csv")[1]


def last_state(folder: Path, iteration: int) -> list[np.ndarray]:
    state = checkpoint.load(folder / "checkpoints" / str(iteration), init(0))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state.replace(key=jax.random.key_data(state.key)))]


def assert_same(one: Path, other: Path, iteration: int) -> None:
    assert metrics(one) == metrics(other)
    assert read_csv(one / "starts.csv") == read_csv(other / "starts.csv")
    assert [row[0] for row in read_csv(one / "starts.csv")[1]] == [str(k) for k in range(1, iteration + 1)]
    for a, b in zip(last_state(one, iteration), last_state(other, iteration), strict=True):
        np.testing.assert_array_equal(a, b)


def script(run_dir: Path, iterations: int, delay: float, *overrides: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.fake_program", str(run_dir), str(iterations), str(delay), *overrides]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_run_writes_one_row_per_iteration_and_everything_else(tmp_path: Path) -> None:
    folder = train(tmp_path, "iterations=7") / "seed0"
    assert [row[0] for row in metrics(folder)] == [str(k) for k in range(1, 8)]
    assert checkpoint.iterations(folder / "checkpoints") == [4, 6, 7]
    # Every third iteration, and the final one with more episodes.
    assert [(row[0], row[-2]) for row in evaluations(folder)] == [("3", "10"), ("6", "10"), ("7", "20")]
    assert read_config(folder) == fake_config(tmp_path, "iterations=7")
    assert len(list((folder / "tensorboard").iterdir())) == 1


def test_the_time_of_reaching_half_and_nine_tenths_is_kept_and_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def evaluate(episodes: int) -> Any:
        result = make_evaluate(episodes)

        def known(state: Any, key: Any) -> Any:  # 0.3, 0.6, 0.9, ... after iterations 3, 6, 9
            return result(state, key).replace(successes_stochastic=jnp.minimum(state.iteration, 10) * episodes // 10)

        known.__name__ = f"known_{episodes}"
        return known

    monkeypatch.setattr("tests.fake_program.make_evaluate", evaluate)
    folder = train(tmp_path, "iterations=8") / "seed0"
    assert "0.5 on rho_0 after " in capsys.readouterr().out
    header, rows = read_csv(folder / "reached.csv")
    assert header == ["iteration", "env_steps", "level", "seconds", "success_stochastic", "episodes"]
    assert [(row[0], row[2], row[4]) for row in rows] == [("6", "0.5", "0.6")]
    assert float(rows[0][3]) > 0
    train(tmp_path, "iterations=12")
    assert capsys.readouterr().out.count(" on rho_0 after ") == 1
    later = read_csv(folder / "reached.csv")[1]
    assert later[0] == rows[0]
    assert [(row[0], row[2]) for row in later] == [("6", "0.5"), ("9", "0.9")]
    assert float(later[1][3]) > float(rows[0][3])


LOGGER = """
class Notes:
    def __init__(self, config, folder):
        self.file = (folder / "notes.txt").open("a")
        self.file.write(f"{config['trpo.max_kl']} {folder.name}\\n")

    def log(self, iteration, values):
        if iteration == 5 and "env_steps" in values:
            raise ConnectionError("the network is down")
        self.file.write(f"{iteration} {' '.join(sorted(values))}\\n")

    def close(self):
        self.file.write("closed\\n")
        self.file.close()
"""


def test_a_logger_of_ones_own_gets_all_numbers_and_cannot_stop_the_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "notes.py"
    own.write_text(LOGGER)
    folder = train(tmp_path / "runs", f"logger={own}:Notes", "iterations=3") / "seed0"
    first, *lines, last = (folder / "notes.txt").read_text().splitlines()
    assert (first, last) == ("0.01 seed0", "closed")
    header, _ = read_csv(folder / "metrics.csv")
    assert set(lines[0].split()[1:]) == set(header)
    assert "3 rho_0/success_mean" in lines[-1]
    train(tmp_path / "runs", f"logger={own}:Notes", "iterations=6")
    assert "logger" in (said := capsys.readouterr().err)
    assert "ConnectionError: the network is down; training goes on without it" in said
    assert len(metrics(folder)) == 6
    train(tmp_path / "runs", "iterations=7")  # a run may go on with another logger, or none
    (tmp_path / "other.py").write_text(LOGGER.replace("def log", "def note").replace("Notes", "Silent"))
    with pytest.raises(ConfigError, match="Silent has no log"):
        train(tmp_path / "runs", f"logger={tmp_path}/other.py:Silent", "iterations=8")


def test_the_episodes_of_the_final_evaluation_are_kept_for_each_seed(tmp_path: Path) -> None:
    both = train(tmp_path / "both", "iterations=4", "num_seeds=2")
    alone = train(tmp_path / "alone", "iterations=4", "seed=1")
    for folder in (both / "seed0", both / "seed1", alone / "seed1"):
        header, rows = read_csv(folder / "final_evaluation.csv")
        columns = dict(zip(header, zip(*rows)))
        assert set(columns["iteration"]) == {"4"}
        assert columns["start"] == tuple(map(str, range(20)))
        assert columns["success_stochastic"].count("1") == round(20 * float(evaluations(folder)[-1][2]))
    files = [(folder / "seed1" / "final_evaluation.csv").read_bytes() for folder in (both, alone)]
    assert files[0] == files[1]


def test_the_report_is_written_at_the_end_and_says_what_it_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = train(tmp_path, "iterations=2", "num_seeds=2")
    out = capsys.readouterr().out
    for seed in ("seed0", "seed1"):
        assert (folders / seed / "report.html").exists()
        assert f"writing {folders / seed / 'report.html'}: " in out
    assert out.count("no videos: nothing to see") == 2
    folder = train(tmp_path / "without", "iterations=2", "write_report=false") / "seed0"
    assert not (folder / "report.html").exists()


def full(*args: object) -> None:
    raise OSError(28, "No space left on device")


def broken(folder: Path) -> list[str]:
    raise ZeroDivisionError("broken")


@pytest.mark.parametrize(
    ("fails", "says", "command"),
    [
        ({"report": broken}, "ZeroDivisionError: broken", "python -m rcg_jax.report run="),
        ({"export": full}, "No space left on device", "python -m rcg_jax.export run="),
    ],
)
def test_a_report_or_policy_file_that_cannot_be_made_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fails: dict[str, Any], says: str, command: str
) -> None:
    config = fake_config(tmp_path, "iterations=2")
    program = dataclasses.replace(load_fake(config), **fails)
    loop.run(config, report=Reporter(), command="again", load=lambda config: program)
    folder = tmp_path / "ring_peg" / "reverse" / "seed0"
    (warning,) = capsys.readouterr().err.splitlines()
    assert says in warning
    assert f"{command}{folder}" in warning
    assert (folder / "picture.png").exists()
    assert checkpoint.iterations(folder / "checkpoints") == [2]
    assert len(metrics(folder)) == 2
    assert len(evaluations(folder)) == 1


def test_more_iterations_continue_and_equal_an_uninterrupted_run(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", "iterations=9") / "seed0"
    for iterations in (3, 4, 9):
        parts = train(tmp_path / "parts", f"iterations={iterations}") / "seed0"
    assert_same(parts, whole, 9)
    assert evaluations(whole)[-1] == evaluations(parts)[-1]


def test_a_finished_run_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = train(tmp_path, "iterations=4") / "seed0"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for iterations in (4, 2):
        train(tmp_path, f"iterations={iterations}")
        assert f"complete: 4 of {iterations}" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_rows_after_the_checkpoint_are_dropped_and_computed_again(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", "iterations=5") / "seed0"
    killed = train(tmp_path / "killed", "iterations=5") / "seed0"
    # As after a kill in iteration 6, with the checkpoint of 5 never written and a row cut short.
    shutil.rmtree(killed / "checkpoints" / "5")
    with (killed / "metrics.csv").open("a") as file:
        file.write("6,6000,0.1")
    train(tmp_path / "killed", "iterations=5")
    assert_same(killed, whole, 5)
    assert evaluations(killed) == evaluations(whole)


def test_a_missing_evaluation_is_made_up_for(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", "iterations=8", "checkpoint_every=3") / "seed0"
    other = train(tmp_path / "other", "iterations=3", "checkpoint_every=3") / "seed0"
    header = (other / "eval.csv").read_text().splitlines()[0]
    (other / "eval.csv").write_text(header + "\n")
    train(tmp_path / "other", "iterations=8", "checkpoint_every=3")
    assert evaluations(other) == evaluations(whole)


def test_changed_settings_are_refused_with_the_fields_that_differ(tmp_path: Path) -> None:
    train(tmp_path, "iterations=2")
    with pytest.raises(ConfigError) as error:
        train(tmp_path, "iterations=4", "engine=native", "trpo.max_kl=0.02", "policy.hidden=[8]", "eval_every=1")
    message = str(error.value)
    assert "\n" not in message
    for part in ("engine mjx -> native", "trpo.max_kl 0.01 -> 0.02", "policy.hidden [64, 64] -> [8]", "run_dir"):
        assert part in message
    for part in ("iterations 2", "eval_every"):
        assert part not in message


def test_settings_that_do_not_touch_training_may_change(tmp_path: Path) -> None:
    folder = train(tmp_path / "a", "iterations=2") / "seed0"
    train(tmp_path / "a", "iterations=6", "eval_every=1", "checkpoint_every=3", "evaluation.final_episodes=30")
    whole = train(tmp_path / "b", "iterations=6") / "seed0"
    assert_same(folder, whole, 6)
    assert read_config(folder).eval_every == 1


def test_two_seeds_write_what_each_writes_alone(tmp_path: Path) -> None:
    both = train(tmp_path / "both", "iterations=5", "num_seeds=2", "seed=3")
    alone = train(tmp_path / "alone", "iterations=5", "seed=4")
    train(tmp_path / "alone", "iterations=5", "seed=3")
    for seed in ("seed3", "seed4"):
        assert_same(both / seed, alone / seed, 5)
        assert evaluations(both / seed) == evaluations(alone / seed)
        names = [sorted(p.name for p in folder.iterdir()) for folder in (both / seed, alone / seed)]
        assert names[0] == names[1]
        config = read_config(both / seed)
        assert (config.seed, config.num_seeds) == (int(seed[-1]), 1)


def test_seeds_trained_together_resume_alone_and_the_other_way_round(tmp_path: Path) -> None:
    together = train(tmp_path / "a", "iterations=3", "num_seeds=2")
    train(tmp_path / "a", "iterations=6", "seed=1")
    whole = train(tmp_path / "b", "iterations=6", "num_seeds=2")
    assert_same(together / "seed1", whole / "seed1", 6)
    with pytest.raises(loop.RunError, match="run the seeds alone"):
        train(tmp_path / "a", "iterations=8", "num_seeds=2")
    train(tmp_path / "a", "iterations=6")
    train(tmp_path / "a", "iterations=8", "num_seeds=2")
    assert_same(together / "seed0", train(tmp_path / "b", "iterations=8", "num_seeds=2") / "seed0", 8)


def test_seeds_resume_from_the_newest_checkpoint_that_all_have(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", "iterations=8", "num_seeds=2")
    killed = train(tmp_path / "killed", "iterations=8", "num_seeds=2")
    # As after a kill between the renames of the two seeds' last checkpoints.
    shutil.rmtree(killed / "seed1" / "checkpoints" / "8")
    train(tmp_path / "killed", "iterations=8", "num_seeds=2")
    for seed in ("seed0", "seed1"):
        assert_same(killed / seed, whole / seed, 8)


def test_a_damaged_checkpoint_falls_back_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = train(tmp_path / "whole", "iterations=8") / "seed0"
    folder = train(tmp_path / "damaged", "iterations=6") / "seed0"
    newest = folder / "checkpoints" / "6"
    file = max((path for path in (newest / "state").rglob("*") if path.is_file()), key=lambda p: p.stat().st_size)
    file.write_bytes(file.read_bytes()[:-1])
    capsys.readouterr()
    train(tmp_path / "damaged", "iterations=8")
    warnings = capsys.readouterr().err.splitlines()
    assert len(warnings) == 1
    assert str(newest) in warnings[0]
    assert "bytes" in warnings[0]
    assert "iteration 4" in warnings[0]
    assert_same(folder, whole, 8)
    assert (folder / "checkpoints" / "damaged-6").is_dir()


def test_nothing_is_overwritten_where_all_checkpoints_are_damaged(tmp_path: Path) -> None:
    folder = train(tmp_path, "iterations=6") / "seed0"
    for path in (folder / "checkpoints").iterdir():
        (path / "manifest.json").unlink()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(loop.RunError, match=r"no intact checkpoint.*manifest.json is missing.*nothing was changed"):
        train(tmp_path, "iterations=8")
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def begun(config: Config) -> RunFolder:
    """A folder with a run that has got to its first checkpoint."""
    folder = RunFolder(config, 0)
    folder.open()
    folder.write_config()
    folder.close()
    (folder.checkpoints / "1").mkdir(parents=True)
    return folder


def test_a_refusal_says_what_the_task_asks_for_and_the_words_that_continue_the_run(tmp_path: Path) -> None:
    words = ["task=ring_peg", f"run_dir={tmp_path}"]
    folder = begun(compose_config([*words, "policy.hidden=[8,9]", "curriculum.rho_0_share=0.5"]))
    now, asked = resolve(compose_config(words), ())
    with pytest.raises(ConfigError) as error:
        RunFolder(now, 0).check([word.partition("=")[0] for word in asked])
    assert "policy.action_repeat 1 -> 4" in str(error.value)
    assert "(policy.action_repeat: as the task now sets)" in str(error.value)
    old = str(error.value).partition("the old settings to continue it: ")[2].split()
    assert set(old) == {"policy.action_repeat=1", "policy.hidden=[8,9]", "curriculum.rho_0_share=0.5"}
    resolved, _ = resolve(compose_config([*words, *old]), [word.partition("=")[0] for word in old])
    RunFolder(resolved, 0).check()
    assert read_config(folder.path) == resolved


def test_sizes_that_are_left_open_may_come_out_differently(tmp_path: Path) -> None:
    """As on another number of devices."""
    words = ["task=point_maze", f"run_dir={tmp_path}"]
    begun(compose_config([*words, "rollout.num_envs=80", "rollout.batch_size=20000"]))
    sizes = ["rollout.num_envs=100", "rollout.batch_size=20000"]
    with pytest.raises(ConfigError, match=r"settings: rollout\.num_envs 80 -> 100; use"):  # not of the devices' making
        RunFolder(compose_config([*words, *sizes]), 0).check(left_open=["rollout.num_envs", "rollout.batch_size"])
    now = RunFolder(compose_config([*words, *sizes, "devices=2"]), 0)
    now.check(left_open=["rollout.num_envs", "rollout.batch_size"])
    with pytest.raises(ConfigError, match=r"settings: rollout\.num_envs 80 -> 100; use"):
        now.check(left_open=["rollout.batch_size"])


def test_a_folder_keeps_the_settings_of_the_program(tmp_path: Path) -> None:
    """Those that were left open as they come to; and a run that leaves them open again goes on."""

    def load(config: Config) -> Program:
        program = load_fake(config)
        rollout = dataclasses.replace(config.rollout, num_envs=sizes.pop(0))
        return dataclasses.replace(program, config=dataclasses.replace(config, rollout=rollout))

    sizes = [80, 100]
    folder = tmp_path / "ring_peg" / "reverse" / "seed0"
    for iterations, envs, devices in ((2, 80, 1), (4, 100, 2)):
        config = fake_config(tmp_path, f"iterations={iterations}", f"devices={devices}")
        loop.run(config, report=Reporter(), command="again", load=load)
        assert read_config(folder).rollout.num_envs == envs
    assert len(metrics(folder)) == 4


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    with pytest.raises(ConfigError, match=rf"run_dir={file}: must be a folder, and a file is there"):
        RunFolder(compose_config(["task=point_maze", f"run_dir={file}"]), 0).open()
    assert file.read_text() == "mine"


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    folder = RunFolder(fake_config(tmp_path), 0)
    folder.open()
    with pytest.raises(FolderInUseError):
        RunFolder(fake_config(tmp_path), 0).open()
    with pytest.raises(loop.RunError, match="another process"):
        train(tmp_path, "iterations=2")
    folder.close()
    train(tmp_path, "iterations=2")


@pytest.mark.slow
def test_a_signal_finishes_the_iteration_and_saves(tmp_path: Path) -> None:
    """SIGTERM; see test_kill.py for Ctrl-C."""
    run = script(tmp_path / "a", 50, 0.3, "checkpoint_every=50")
    folder = tmp_path / "a" / "ring_peg" / "reverse" / "seed0"
    wait_for_rows([run], folder, 2)
    run.send_signal(signal.SIGTERM)
    out, err = run.communicate(timeout=30)
    assert run.returncode == 143, err
    done = len(metrics(folder))
    assert 2 <= done < 50
    assert checkpoint.iterations(folder / "checkpoints") == [done]
    assert f"saved at iteration {done}; resume with: again" in out
    total = done + 2
    train(tmp_path / "a", f"iterations={total}", "checkpoint_every=50")
    assert_same(folder, train(tmp_path / "b", f"iterations={total}") / "seed0", total)


@pytest.mark.slow
def test_a_second_signal_stops_at_once(tmp_path: Path) -> None:
    run = script(tmp_path, 50, 8.0)
    folder = tmp_path / "ring_peg" / "reverse" / "seed0"
    deadline = time.monotonic() + 60
    while not (folder / "config.yaml").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(4.0)  # until it is in an iteration, which takes 8 s
    run.send_signal(signal.SIGINT)
    time.sleep(0.7)
    assert run.poll() is None, "the first signal must wait for the iteration"
    run.send_signal(signal.SIGINT)
    run.wait(timeout=2.0)
    assert run.returncode == 130


@pytest.mark.slow
def test_kills_at_any_moment_cost_nothing_but_time(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "ring_peg" / "reverse"
    settings = ("checkpoint_every=1", "num_seeds=2")
    pauses = np.random.default_rng(0)
    # Fast iterations: most of the time a run is inside a save, where a kill could do most harm.
    for _ in range(8):
        run = script(tmp_path / "a", 400, 0.0, *settings)
        before = len(read_csv(folder / "seed0" / "metrics.csv")[1])
        wait_for_rows([run], folder / "seed0", min(before + 2, 400))
        time.sleep(pauses.uniform(0.0, 0.3))
        run.kill()
        run.communicate(timeout=30)
    total = len(read_csv(folder / "seed0" / "metrics.csv")[1]) + 2
    train(tmp_path / "a", f"iterations={total}", *settings)
    whole = train(tmp_path / "b", f"iterations={total}", *settings)
    for seed in ("seed0", "seed1"):
        assert_same(folder / seed, whole / seed, total)
        assert evaluations(folder / seed)[:-1] == evaluations(whole / seed)[:-1]


@pytest.fixture
def small_disk(tmp_path: Path):
    """A file system of 2 MB."""
    target = tmp_path / "disk"
    target.mkdir()
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("mounting a small file system needs root")
    done = subprocess.run([mount, "-t", "tmpfs", "-o", "size=2m", "none", str(target)], capture_output=True)
    if done.returncode:
        pytest.skip(f"no tmpfs here: {done.stderr.decode().strip()}")
    yield target
    subprocess.run(["umount", "-l", str(target)], check=True)


@pytest.mark.slow
def test_a_full_disk_costs_warnings_and_nothing_else(tmp_path: Path, small_disk: Path) -> None:
    folder = small_disk / "ring_peg" / "reverse" / "seed0"
    run = script(small_disk, 24, 0.25, "checkpoint_every=1")
    filler = small_disk / "filler"
    # Between two saves: what Orbax's own threads print in the middle of one is not ours to test.
    while 2 not in checkpoint.iterations(folder / "checkpoints"):
        assert run.poll() is None, run.communicate()
    for size in (2**16, 2**12, 1):
        with filler.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while file.write(b"x" * size):
                pass
    full = len(read_csv(folder / "metrics.csv")[1])
    kept = checkpoint.iterations(folder / "checkpoints")
    lines: list[str] = []
    assert run.stderr is not None
    while not any("no checkpoint at iteration" in line for line in lines):
        lines.append(run.stderr.readline())
        assert lines[-1], "the run has ended"
    # While the disk is full: what existed is whole.
    for iteration in kept[-1:]:
        checkpoint.load(folder / "checkpoints" / str(iteration), init(0))
    assert len(read_csv(folder / "metrics.csv")[1]) <= full + 64  # a row may still fit into the last page
    filler.unlink()
    lines += run.stderr.readlines()
    assert run.wait(60) == 0, lines
    assert all(line.startswith("warning: ") for line in lines), lines
    assert any("No space left on device" in line and "no checkpoint at iteration" in line for line in lines), lines
    whole = train(tmp_path / "whole", "iterations=24") / "seed0"
    assert_same(folder, whole, 24)
