"""``task=path/to/file.py:ClassName``: what is found, where it is kept, what is refused; and the documented example."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rcg_jax import feasible, run
from rcg_jax.cli import sweep
from rcg_jax.config import compose as cli
from rcg_jax.config.class_path import class_name, resolve_name
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.starts_file import load_states
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.load import load_run
from rcg_jax.runs.settings import read_config
from rcg_jax.tasks import RingPeg, make_task, task_class

ROOT = Path(__file__).parents[2]
DOC = (ROOT / "docs" / "custom_tasks.md").read_text()
EXAMPLE = ROOT / "examples" / "reacher" / "reacher.py"
REACHER = "examples/reacher/reacher.py:Reacher"

#: The smallest settings of each documented command.
TINY = {
    "feasible": "max_rounds=1 num_walks=16 walk_length=200",
    "run": "iterations=1 eval_every=0 rollout.num_envs=10 rollout.batch_size=1000 trpo.iterations=3 "
    "baseline.minibatch_size=500 curriculum.num_new=20 curriculum.num_old=10 curriculum.num_candidates=200 "
    "evaluation.final_episodes=10 write_report=false",
    "evaluate": "episodes=10",
    "render": "episodes=1 width=160 height=120",
}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the example, which is the working directory."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("*.npz", "*.json"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


class TestNames:
    def test_paths_become_absolute(self, project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert cli.compose_config([f"task={REACHER}"]).task == f"{project}/{REACHER}"
        assert resolve_name("task", f"./examples/../{REACHER}") == f"{project}/{REACHER}"
        assert resolve_name("task", "ring_peg") == "ring_peg"
        assert resolve_name("task", "rcg_jax.tasks:RingPeg") == "rcg_jax.tasks:RingPeg"  # imported there
        monkeypatch.setenv("HOME", str(project))
        assert cli.compose_config([f"task='~/{REACHER}'"]).task == f"{project}/{REACHER}"

    @pytest.mark.parametrize("folder", ["2024/v1.0+x@y%", "two words"])
    def test_plain_paths_need_no_quotes(self, project: Path, folder: str) -> None:
        write(project / folder / "mine.py", "class Mine: ...")
        assert cli.compose_config([f"task={folder}/mine.py:Mine"]).task == f"{project}/{folder}/mine.py:Mine"

    @pytest.mark.parametrize("folder", ["my (old) tasks", "a=b", "é", "a,b", "~"])
    def test_others_need_quotes_and_the_refusal_says_so(self, project: Path, folder: str) -> None:
        write(project / folder / "mine.py", "class Mine: ...")
        path = f"./{folder}/mine.py:Mine"
        assert cli.compose_config([f"task='{path}'"]).task == f"{project}/{folder}/mine.py:Mine"
        with pytest.raises(ConfigError, match=r"quote|several values"):
            cli.compose_config([f"task={path}"])

    def test_the_folder_of_a_run_is_called_after_the_class(self, project: Path) -> None:
        config = cli.compose_config([f"task={REACHER}"])
        assert class_name(config.task) == "Reacher"
        assert RunFolder(config, 3).path == Path("runs/Reacher/reverse/seed3")

    def test_two_classes_of_one_name_in_a_sweep_would_share_a_folder(self, project: Path) -> None:
        write(project / "a.py", "class One: ...")
        write(project / "b.py", "class One: ...")
        with pytest.raises(ConfigError, match=r"2 members of this sweep would write to runs/One/reverse/seed0"):
            sweep.check(["task=a.py:One,b.py:One"])


SOURCE = "x = 1\nclass Other: ...\nclass Worker: ...\n"
REFUSED = {
    "ring_pegg": ["must be one of", "ring_peg", "path/to/file.py:ClassName", "did you mean ring_peg?"],
    "none.py:Mine": ["no such file", "none.py"],
    "good.py": ["no class is named", "good.py:ClassName", "it defines Other, Worker"],
    "good.py:a/b": ["no class is named"],
    "good.py:Worke": ["has no class Worke", "it defines Other, Worker", "did you mean Worker?"],
    "empty.py:Mine": ["it defines no class"],
    "broken.py:Mine": ["broken.py, line 2", "'('"],
    "binary.py:Mine": ["binary.py"],
    "package.nothing:Mine": ["no module package.nothing"],
    "nowhere.nothing:Mine": ["no module nowhere.nothing", "path/to/file.py:ClassName"],
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_wrong_name_is_refused_in_one_line_without_importing_anything(project: Path, name: str) -> None:
    write(project / "good.py", SOURCE)
    write(project / "empty.py", "")
    write(project / "broken.py", "x = 1\ny = (\n")
    (project / "binary.py").write_bytes(b"\xff\xfe\x00class")
    write(project / "package" / "__init__.py", "raise RuntimeError('it was imported')")
    sys.path.insert(0, str(project))
    with pytest.raises(ConfigError) as error:
        resolve_name("task", name)
    assert str(error.value).startswith(f"task={name}: ")
    assert "\n" not in str(error.value)
    for part in REFUSED[name]:
        assert part in str(error.value)


UNUSABLE = {
    "raises.py:Mine": ["raises.py failed, line 2: ZeroDivisionError"],
    "exits.py:Mine": ["exits.py failed, line 1: SystemExit: 3"],
    "needs.py:Mine": ["needs.py failed, line 1: ModuleNotFoundError", "no_such_library"],
    "plain.py:Mine": ["Mine is no subclass of rcg_jax.Task"],
    "number.py:Mine": ["Mine is no class"],
    "star.py:Mine": ["no such class in"],
    "lacks.py:Mine": ["lacks xml, distance, goal_state", "is_goal"],
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_class_that_cannot_be_used_is_refused_before_anything_is_compiled(
    project: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write(project / "raises.py", "class Mine: ...\nx = 1 / 0\n")
    write(project / "exits.py", "raise SystemExit(3)\nclass Mine: ...\n")
    write(project / "needs.py", "import no_such_library\nclass Mine: ...\n")
    write(project / "plain.py", "class Mine: ...\n")
    write(project / "number.py", "Mine = 3\n")
    write(project / "star.py", "from math import *\n")
    write(project / "lacks.py", "import rcg_jax\nclass Mine(rcg_jax.Task):\n    def observe(self, s): return s.qpos\n")
    for main in (run.main, feasible.main):
        assert main([f"task={name}", "engine=native"]) == 2
        out, err = capsys.readouterr()
        *before, last = err.splitlines()
        assert last.startswith("error: ")
        assert not before or (before[0].startswith("Traceback") and ".py" in before[1]), err  # of the user's own code
        assert "compiling" not in out
        for part in UNUSABLE[name]:
            assert part in err
    assert not (project / "runs").exists()


class TestClass:
    def test_files_beside_it_can_be_imported_and_the_file_is_imported_once(self, project: Path) -> None:
        write(project / "tasks" / "helper_of_mine.py", "from rcg_jax.tasks import RingPeg\nRADIUS = 0.01\n")
        write(
            project / "tasks" / "mine.py",
            "from helper_of_mine import RADIUS, RingPeg\nclass Mine(RingPeg):\n    goal_radius = RADIUS\n",
        )
        cls = task_class("tasks/mine.py:Mine")
        assert issubclass(cls, RingPeg)
        assert cls.goal_radius == 0.01
        assert task_class(f"{project}/tasks/mine.py:Mine") is cls

    def test_two_files_of_one_name_are_two_modules(self, project: Path) -> None:
        for folder in ("a", "b"):
            text = f"from rcg_jax.tasks import RingPeg\nclass Mine(RingPeg):\n    label = '{folder}'\n"
            write(project / folder / "mine.py", text)
        assert [task_class(f"{folder}/mine.py:Mine").label for folder in ("a", "b")] == ["a", "b"]  # type: ignore

    def test_starts_are_not_inherited(self) -> None:
        class Harder(RingPeg):
            horizon = 100

        class Same(RingPeg):
            name = "same"
            feasible_file = RingPeg.feasible_file

        assert Harder.name == "Harder"
        assert Harder.feasible_file == Path(__file__).resolve().parent / "test_own_task.Harder.npz"
        assert (Same.name, Same.feasible_file) == ("same", RingPeg.feasible_file)

    def test_unstable_states_are_never_reset_silently(self) -> None:
        assert "autoreset" not in EXAMPLE.with_suffix(".xml").read_text()
        task = make_task(f"{EXAMPLE}:Reacher", "native")
        assert task.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_starts_are_generated_beside_the_file(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main([f"task={REACHER}", "engine=native"]) == 2
    error = capsys.readouterr().err
    said = error.partition("make them with ")[2].strip()
    assert said == f"python -m rcg_jax.feasible task={REACHER}"
    assert feasible.main([f"task={REACHER}", *TINY["feasible"].split()]) == 0
    file = project / "examples" / "reacher" / "reacher.Reacher.npz"
    np.testing.assert_array_equal(make_task(REACHER, "native").feasible_starts().qpos, load_states(file)[0])
    assert f'"command": "python -m rcg_jax.feasible task={REACHER} ' in file.with_suffix(".json").read_text()


def test_another_file_with_a_class_of_the_same_name_does_not_continue_a_run(tmp_path: Path, command: Callable) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder / "mine.py", "from rcg_jax.tasks import RingPeg\n\nclass Mine(RingPeg): ...")
    small = ("iterations=2", "evaluation.final_episodes=5")
    assert command("task=a/mine.py:Mine", *small).code == 0
    done = command("task=b/mine.py:Mine", *small)
    assert done.code == 2
    assert f"task {tmp_path}/a/mine.py:Mine -> {tmp_path}/b/mine.py:Mine" in done.err
    assert "is complete" in command("task=./a/../a/mine.py:Mine", *small).out


def test_a_run_whose_file_was_moved_says_where_to_correct_it(project: Path) -> None:
    folder = RunFolder(cli.compose_config([f"task={REACHER}"]), 0)
    folder.open()
    folder.write_config()
    folder.close()
    assert read_config(folder.path).task == f"{project}/{REACHER}"
    (project / "examples").rename(project / "moved")
    with pytest.raises(ConfigError, match=r"no such file: .*if it was moved, correct its path in .*config\.yaml"):
        load_run(folder.path)


class TestExample:
    def test_the_document_shows_it_as_it_is(self) -> None:
        shown = [block.strip() for block in re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)]
        assert EXAMPLE.read_text().strip() in shown

    def test_engine_mjx_takes_its_fast_path(self) -> None:
        assert make_task(f"{EXAMPLE}:Reacher", "mjx").engine.solves_contacts  # type: ignore[attr-defined]

    @pytest.mark.slow
    def test_the_documented_commands(self, project: Path) -> None:
        block = re.findall(r"```sh\n(.*?)```", DOC, re.DOTALL)[0]
        lines = block.strip().splitlines()
        assert [line.split()[:2] for line in lines] == [["rcg", name] for name in TINY]
        for line in lines:
            _, name, *words = shlex.split(line)
            done = subprocess.run(
                [sys.executable, "-m", "rcg_jax", name, *words, *TINY[name].split()],
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                cwd=project,
                capture_output=True,
                text=True,
                timeout=600,
            )
            if "no OpenGL context" in done.stderr:
                pytest.skip(done.stderr)
            assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        folder = project / "runs" / "Reacher" / "reverse" / "seed0"
        names = {path.name for path in folder.iterdir()}
        assert {"learning_curve.png", "starts.png", "evaluation.csv", "rollouts.mp4", "policy.npz"} <= names
