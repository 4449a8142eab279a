"""The plan of all runs: what it contains, how far each is, and that one failure or stop leaves the rest alone."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from experiments.live import Display, last_line
from experiments.states import Estimates

from experiments import states
from experiments.common import RESULTS
from experiments.paper import plan, provenance, reproduce
from experiments.paper.collect import collect
from experiments.paper.plan import BUDGETS, CURVES, Curve
from rcg_jax.config.compose import compose_config
from rcg_jax.io.tables import CsvLog
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.recorder import EVAL_COLUMNS

CPU, GPU = BUDGETS["cpu"], BUDGETS["gpu"]
RING = Curve("ring_peg", "reverse")


def write(folder: RunFolder, iterations: int, *, seconds: float = 2.0, final: bool = False) -> None:
    """A run that got so far, at so many seconds an iteration."""
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.write_config()
    log = CsvLog(folder.metrics_file, ["iteration", "env_steps", "wall_s", "steps_per_s"], keep=0)
    for i in range(1, iterations + 1):
        log.append({"iteration": i, "env_steps": 250_000 * i, "wall_s": seconds * i, "steps_per_s": 1.0})
    if final:
        cells = dict.fromkeys(EVAL_COLUMNS, 0)
        evals = CsvLog(folder.eval_file, EVAL_COLUMNS, keep=0)
        evals.append({**cells, "iteration": iterations, "episodes": folder.config.evaluation.final_episodes})


def test_cpu_trains_each_seed_by_itself_and_an_accelerator_all_of_them_in_one_program(tmp_path: Path) -> None:
    cpu = plan.members(CPU, CURVES, range(5), tmp_path)
    assert len(cpu) == 5 * len(CURVES)
    # Every figure has its curve early: a seed of all curves comes before the next seed of any.
    assert {member.curve for member in cpu[: len(CURVES)]} == set(CURVES)
    gpu = plan.members(GPU, [RING], [0, 1, 2, 5], tmp_path)
    assert [(member.config.seed, member.config.num_seeds) for member in gpu] == [(0, 3), (5, 1)]
    assert gpu[0].config.engine == "mjx"
    # What is shown is what runs, and composes to what is planned.
    for member in [*cpu[:3], gpu[0], gpu[1]]:
        assert compose_config(member.words) == member.config
    folders = [folder.path for member in cpu for folder in member.folders]
    assert len(set(folders)) == len(folders)


def test_further_settings_replace_those_of_the_budget(tmp_path: Path) -> None:
    (member,) = plan.members(CPU, [RING], [3], tmp_path, ["iterations=7", "trpo.max_kl=0.02"])
    assert member.config.iterations == 7
    assert member.config.trpo.max_kl == 0.02
    assert sum(word.startswith("iterations=") for word in member.words) == 1


def test_states_of_runs(tmp_path: Path) -> None:
    whole, part, none, other = plan.members(CPU, [RING], range(4), tmp_path)
    total = whole.config.iterations
    write(whole.folders[0], total, final=True)
    write(part.folders[0], 17)
    write(RunFolder(compose_config([*other.words, "trpo.max_kl=0.5"]), 3), 5)
    assert states.state(whole).finished
    assert states.state(part).words(total) == f"17 of {total}"
    assert states.state(none).words(total) == "not begun"
    assert "trpo.max_kl 0.5 -> " in states.state(other).conflict
    # All iterations without the final evaluation are not the end.
    write(none.folders[0], total)
    assert not states.state(none).finished
    lock = os.open(part.folders[0].path / ".lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    assert states.state(part).busy
    os.close(lock)
    assert not states.state(part).busy


def test_a_vmapped_member_is_as_far_as_its_slowest_seed(tmp_path: Path) -> None:
    (member,) = plan.members(GPU, [RING], range(2), tmp_path)
    write(member.folders[0], 12)
    assert states.state(member).done == 0
    write(member.folders[1], 10)
    assert states.state(member).done == 10


def test_time_left_follows_what_was_measured(tmp_path: Path) -> None:
    results = tmp_path / "results"
    results.mkdir()
    header = "task,method,reward,preset,seed,settings,iterations,seconds,engine,together\n"
    rows = ["ring_peg,reverse,sparse,default,0,,10,50,native,1", "ring_peg,reverse,sparse,default,1,,10,900,native,5"]
    (results / "runs.csv").write_text(header + "\n".join(rows) + "\n")
    members = plan.members(CPU, [RING, Curve("ring_peg", "uniform")], [0], tmp_path)
    estimates = Estimates.of(CPU, members, results)
    point = CPU.lengths["point_maze"].seconds
    assert point is not None
    assert estimates.seconds(Curve("point_maze", "oracle")) == (3 * point, "estimated")
    assert estimates.seconds(Curve("point_maze", "reverse"), 5) == (
        pytest.approx(5 * states.TOGETHER * point),
        "estimated",
    )
    assert estimates.seconds(RING) == (5.0, "as committed")
    assert estimates.seconds(members[1].curve) == (5.0, "as committed, other methods")
    write(members[0].folders[0], 10, seconds=3.0)
    estimates.learn(members[0])
    assert estimates.seconds(RING) == (3.0, "measured here")
    left = estimates.left(members[0], states.state(members[0]))
    assert left == pytest.approx(states.OVERHEAD_S + 3.0 * (members[0].config.iterations - 10))
    # An accelerator's times are not those of a CPU, and nobody has measured them.
    assert Estimates.of(GPU, plan.members(GPU, [RING], range(5), tmp_path / "g"), results).seconds(RING)[0] is None


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


def test_table_and_sweeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    common = (f"run_dir={tmp_path}", f"out={tmp_path}", "task=ring_peg", "method=reverse", "reward=sparse")
    common = (*common, "preset=default", "seed=0,1")
    write(plan.members(CPU, [RING], [0], tmp_path / "cpu")[0].folders[0], 300, seconds=2.0, final=True)
    code, out, _ = say(capsys, monkeypatch, "plan=table", *common)
    assert code == 0
    assert re.search(r"ring_peg reverse seed=0 +finished", out)
    assert re.search(r"ring_peg reverse seed=1 +not begun +07:10 +2.0 s +measured here", out)
    assert "1 of 2 runs finished, 07:10 left" in out
    _, out, _ = say(capsys, monkeypatch, "plan=commands", *common)
    assert out.count("\n") == 1
    assert "seed=1" in out
    _, out, _ = say(capsys, monkeypatch, "plan=sweeps", "launcher=submitit_slurm", *common)
    assert out.startswith("python -m rcg_jax.run -m hydra/launcher=submitit_slurm task=ring_peg method=reverse ")
    assert "seed=0,1" in out
    _, out, _ = say(capsys, monkeypatch, "plan=sweeps", "budget=gpu", *common[:-1])
    assert "seed=0 num_seeds=5" in out


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("task=ring", "task=ring: ring is none of point_maze, ant_maze"),
        ("seed=0,x", "seed=0,x: must be numbers"),
        ("method=oracle task=ring_peg", "the figures need no such curve"),
        ("settings=trpo.max_kl=no", "trpo.max_kl=no: must be a number"),
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
from rcg_jax.config.compose import compose_config
from rcg_jax.runs.folder import RunFolder
from tests.test_reproduce import write
config = compose_config(sys.argv[1:])
folder = RunFolder(config, config.seed)
folder.open()
print(f"task {{config.task}}, method {{config.method}}, engine native, CPU, seeds 0: x", flush=True)
if config.method == "uniform":
    sys.exit("error: the disk is full")
if config.method == "all_starts":
    signal.signal(signal.SIGINT, lambda *_: (write(folder, 5), print("saved", flush=True), sys.exit(130)))
    time.sleep(60)
write(folder, config.iterations, final=True)
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = tmp_path / "fake_run.py"
    script.write_text(FAKE.format(path=[str(Path(__file__).parent.parent)]))
    command = property(lambda self: [sys.executable, str(script), *self.words])
    monkeypatch.setattr(plan.Member, "command", command)
    monkeypatch.setattr("experiments.live.LOOK_S", 0.1)
    return tmp_path


def test_a_run_that_fails_leaves_the_others_alone(
    fake: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        *("task=ring_peg", "reward=sparse", "preset=default", "seed=0"),
        *("method=uniform,reverse", f"run_dir={fake}", f"out={fake}"),
    )
    code, out, _ = say(capsys, monkeypatch, *words)
    assert code == 1
    assert "1 of 2 runs finished, 1 failed\n" in out
    assert f"make figures ARGS=results={fake} draws them" in out
    assert "failed: ring_peg uniform seed=0: error: the disk is full\n  resume with: python -m rcg_jax.run" in out
    run = fake / "cpu" / "default_sparse" / "ring_peg" / "reverse" / "seed0"
    (entry,) = provenance.load(run)
    assert entry["jax"]
    assert entry["from_iteration"] == 0
    # Collected without being asked.
    assert "ring_peg,reverse" in (fake / "runs.csv").read_text()
    # Given again, only what failed is tried.
    _, out, _ = say(capsys, monkeypatch, *words)
    assert out.count("resume with") == 1
    assert "[2/2]" not in out
    # Where nothing is finished, there is nothing to draw.
    code, out, _ = say(capsys, monkeypatch, *words[:4], "method=uniform", f"run_dir={fake / 'b'}", words[6])
    assert code == 1
    assert "0 of 1 runs finished, 1 failed\n" in out
    assert "make figures" not in out


def test_what_cannot_be_recorded_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    provenance.record([tmp_path / "gone"], {"device": "x"}, 0)
    assert "provenance.json was not written: No such file" in capsys.readouterr().err


def test_a_stop_reaches_the_run_once_and_waits_until_it_has_saved(fake: Path) -> None:
    program = fake / "program.py"
    program.write_text(
        f"import sys; sys.path[:0] = [{str(Path(__file__).parent.parent)!r}]\n"
        "from experiments import plan, reproduce\n"
        f"plan.Member.command = property(lambda self: [sys.executable, {str(fake / 'fake_run.py')!r}, *self.words])\n"
        "sys.exit(reproduce.main())\n"
    )
    words = ["task=ring_peg", "reward=sparse", "method=all_starts", "seed=0", f"run_dir={fake}", f"out={fake}"]
    process = subprocess.Popen(
        [sys.executable, str(program), *words], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    log = fake / "cpu" / "logs" / "ring_peg_all_starts_seed-0.log"
    deadline = time.monotonic() + 300
    while "engine" not in last_line(log) and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(1.0)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "stopped; resume with: python -m experiments.paper.reproduce task=ring_peg" in out
    assert last_line(log) == "saved"
    assert json.loads((fake / "cpu/default_sparse/ring_peg/all_starts/seed0/provenance.json").read_text())


def test_two_live_lines_are_replaced_and_others_stay(capsys: pytest.CaptureFixture[str]) -> None:
    class Terminal:
        text = ""

        def write(self, text: str) -> int:
            self.text += text
            return len(text)

        def flush(self) -> None: ...

        def isatty(self) -> bool:
            return True

    out = Terminal()
    with Display(out) as display:  # type: ignore[arg-type]
        display.show("1 of 2", "iteration 1")
        display.show("1 of 2", "iteration 2")
        display.say("done")
    up = "\r\033[2A\033[J"
    assert out.text == f"1 of 2\niteration 1\n{up}1 of 2\niteration 2\n{up}done\n"
