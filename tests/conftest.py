"""Fixtures shared by all tests: tasks that are built, and programs that are compiled, once per session."""

from __future__ import annotations

import os
import shutil
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # the native engine, and comparisons to the last bit, need a CPU

import pytest

from rcg_jax import run as rcg_run
from rcg_jax.cli import sweep
from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.report.scene import RenderError, render_still
from rcg_jax.runs import program
from rcg_jax.tasks import Task, make_task
from tests import fake_run, tiny_run


@pytest.fixture(scope="session", autouse=True)
def compilation_cache() -> None:
    """Repeated test runs load their compiled programs from disk."""
    enable_compilation_cache()


@pytest.fixture(scope="session")
def ring_peg_native() -> Task:
    return make_task("ring_peg", "native")


@pytest.fixture(scope="session")
def ring_peg_mjx() -> Task:
    return make_task("ring_peg", "mjx")


@pytest.fixture(scope="session")
def ring_peg_warp() -> Task:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    return make_task("ring_peg", "warp")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the model and the feasible starts of the task tiny, which is registered (:mod:`tests.tiny_run`)."""
    folder = tmp_path_factory.mktemp("tiny")
    with pytest.MonkeyPatch.context() as patch:
        tiny_run.register(folder, patch)
        yield folder


@pytest.fixture(scope="module")
def saved(tiny: Path) -> Path:
    """A run of tiny, with checkpoints of iterations 2 and 3."""
    return tiny_run.save_run(tiny / "runs", iterations=(2, 3))


@pytest.fixture
def run(saved: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may spoil."""
    return Path(shutil.copytree(saved, tmp_path / "run"))


@pytest.fixture(scope="module")
def gl() -> None:
    """Skips where nothing can be drawn."""
    task = make_task("point_maze", "native")
    try:
        render_still(task, task.goal_state, width=32, height=32)
    except RenderError as error:
        pytest.skip(str(error))


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable:
    """``python -m rcg_jax.run WORDS`` in an empty folder, in this process and without physics (:mod:`tests.fake_run`).

    Members of a sweep, each a process in reality, are called as well. Returns exit code, output, and errors.
    """

    class InProcess:
        """A member's process."""

        stdout = None

        def __init__(self, command: list[str], **_: object) -> None:
            try:
                self.code = rcg_run.main(command[3:])
            except Exception:
                traceback.print_exc()
                self.code = 1

        def wait(self) -> int:
            return self.code

    def call(*words: str) -> SimpleNamespace:
        capsys.readouterr()
        code = rcg_run.main(words)
        out, err = capsys.readouterr()
        return SimpleNamespace(code=code, out=out, err=err)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "load_program", fake_run.load)
    monkeypatch.setattr(sweep, "subprocess", SimpleNamespace(Popen=InProcess))
    return call
