"""The plan of all runs: what it contains, how far each is, and that one failure or stop leaves the rest alone."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.common import RESULTS
from experiments.paper import plan, provenance, reproduce
from experiments.paper.collect import collect
from experiments.paper.plan import BUDGETS, CURVES, Curve, Member
from rcg_jax.io.tables import CsvLog
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.recorder import EVAL_COLUMNS
from rcg_jax.tasks.training import training_config

CPU, GPU = BUDGETS["cpu"], BUDGETS["gpu"]
RING = Curve("ring_peg", "reverse")


def folders(member: Member) -> list[RunFolder]:
    return [RunFolder(training_config(member.words), seed) for seed in member.seeds]


def write(folder: RunFolder, iterations: int, *, final: bool = False) -> None:
    """A run that got so far."""
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.write_config()
    log = CsvLog(folder.metrics_file, ["iteration", "env_steps", "wall_s", "steps_per_s"], keep=0)
    for i in range(1, iterations + 1):
        log.append({"iteration": i, "env_steps": 250_000 * i, "wall_s": 2.0 * i, "steps_per_s": 1.0})
    if final:
        cells = dict.fromkeys(EVAL_COLUMNS, 0)
        evals = CsvLog(folder.eval_file, EVAL_COLUMNS, keep=0)
        evals.append({**cells, "iteration": iterations, "episodes": folder.config.evaluation.final_episodes})


def test_cpu_trains_each_seed_by_itself_and_an_accelerator_all_of_them_in_one_program(tmp_path: Path) -> None:
    cpu = plan.members(CPU, CURVES, range(5), tmp_path)
    assert len(cpu) == 5 * len(CURVES)
    # Every figure has its curve early: a seed of all curves comes before the next seed of any.
    assert {member.curve for member in cpu[: len(CURVES)]} == set(CURVES)
    (gpu,) = plan.members(GPU, [RING], [1, 2, 3], tmp_path)
    config = training_config(gpu.words)
    assert (config.engine, config.seed, config.num_seeds, config.iterations) == ("mjx", 1, 3, 1_000)
    paths = [folder.path for member in cpu[: len(CURVES)] for folder in folders(member)]
    assert len(set(paths)) == len(paths), "curves that share task, method and seed lie apart"


def test_how_far_runs_are(tmp_path: Path) -> None:
    whole, part, none = plan.members(CPU, [RING], range(3), tmp_path)
    write(folders(whole)[0], 200, final=True)
    write(folders(part)[0], 17)
    assert [reproduce.done(member) for member in (whole, part, none)] == [
        (200, 200, True),
        (17, 200, False),
        (0, 200, False),
    ]
    # All iterations without the final evaluation are not the end.
    write(folders(none)[0], 200)
    assert reproduce.done(none) == (200, 200, False)


@pytest.fixture(autouse=True)
def results_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that forgets ``out=`` must not put its runs among the committed ones."""

    def guarded(runs: Path, out: Path) -> int:
        assert out.resolve() != RESULTS.resolve(), "say out="
        return collect(runs, out)

    monkeypatch.setattr(reproduce, "collect", guarded)


def say(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["reproduce", *words])
    code = reproduce.main()
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("task=ring", "task=ring: ring is none of point_maze, ant_maze"),
        ("seed=0,x", "seed=0,x: must be numbers"),
        ("method=oracle task=ring_peg", "the figures need no such curve"),
        ("settings=trpo.max_kl=no", "trpo.max_kl=no: must be a number"),
        ("budget=gpu seed=0,2", "seed=0,2: seeds of one program must be consecutive"),
    ],
)
def test_wrong_settings_are_refused_in_a_line(
    word: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = say(capsys, monkeypatch, *word.split(" "))
    assert code == 2
    assert message in err
    assert err.count("\n") == 1
    assert not out


#: Stands for ``python -m rcg_jax.run``: writes a run as fast as it can; method=uniform fails.
FAKE = """
import signal, sys, time
from pathlib import Path
sys.path[:0] = {path!r}
from rcg_jax.runs.folder import RunFolder
from rcg_jax.tasks.training import training_config
from tests.commands.test_reproduce import write
config = training_config(sys.argv[1:])
folder = RunFolder(config, config.seed)
folder.open()
if config.method == "uniform":
    sys.exit("error: the disk is full")
if config.method == "all_starts":
    signal.signal(signal.SIGINT, lambda *_: (write(folder, 5), print("saved", flush=True), sys.exit(130)))
    print("under way", flush=True)
    time.sleep(60)
write(folder, config.iterations, final=True)
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = tmp_path / "fake_run.py"
    script.write_text(FAKE.format(path=[str(Path(__file__).parents[2])]))
    command = property(lambda self: [sys.executable, str(script), *self.words])
    monkeypatch.setattr(plan.Member, "command", command)
    return tmp_path


@pytest.mark.slow
def test_a_run_that_fails_leaves_the_others_alone(
    fake: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        *("task=ring_peg", "reward=sparse", "preset=default", "seed=0"),
        *("method=uniform,reverse", f"run_dir={fake}", f"out={fake}"),
    )
    code, out, err = say(capsys, monkeypatch, *words)
    assert code == 1
    assert "[1/2] python -m rcg_jax.run task=ring_peg method=uniform" in out
    assert "[2/2] python -m rcg_jax.run task=ring_peg method=reverse" in out
    assert re.fullmatch(r"failed: python -m rcg_jax.run task=ring_peg method=uniform .*\n", err)
    (entry,) = provenance.load(fake / "cpu" / "default_sparse" / "ring_peg" / "reverse" / "seed0")
    assert entry["jax"]
    assert entry["from_iteration"] == 0
    # Collected without being asked.
    assert "ring_peg,reverse" in (fake / "runs.csv").read_text()
    # Given again, only what failed is tried.
    _, out, _ = say(capsys, monkeypatch, *words)
    assert "[1/2]" in out
    assert "[2/2]" not in out


@pytest.mark.slow
def test_a_stop_reaches_the_run_once_and_waits_until_it_has_saved(fake: Path) -> None:
    program = fake / "program.py"
    program.write_text(
        f"import sys; sys.path[:0] = [{str(Path(__file__).parents[2])!r}]\n"
        "from experiments.paper import plan, reproduce\n"
        f"plan.Member.command = property(lambda self: [sys.executable, {str(fake / 'fake_run.py')!r}, *self.words])\n"
        "sys.exit(reproduce.main())\n"
    )
    words = ["task=ring_peg", "reward=sparse", "method=all_starts", "seed=0", f"run_dir={fake}", f"out={fake}"]
    process = subprocess.Popen(
        [sys.executable, str(program), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert "under way\n" in iter(process.stdout.readline, "")
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert out.startswith("saved\n\nstopped; the same command goes on\n")
    assert json.loads((fake / "cpu/default_sparse/ring_peg/all_starts/seed0/provenance.json").read_text())
