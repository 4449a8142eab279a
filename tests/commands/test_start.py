"""How a run starts: which engine ``auto`` is, the script ``rcg``, and a plain sweep whose member is killed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import rcg_jax.__main__
from rcg_jax.config.compose import compose_config
from rcg_jax.config.settings import ConfigError
from rcg_jax.runs import engine
from rcg_jax.runs.engine import choose_engine
from rcg_jax.runs.folder import RunFolder

ROOT = Path(__file__).parents[2]


def chosen(*words: str) -> str:
    return choose_engine(compose_config(list(words)))[0].engine


def test_auto_suits_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = f"run_dir={tmp_path}"
    monkeypatch.setattr(engine, "has_accelerator", lambda: False)
    assert chosen(here) == "native"
    assert chosen(here, "devices=2") == chosen(here, "hosts.coordinator=slurm") == "mjx"
    assert chosen(here, "engine=mjx") == "mjx"
    monkeypatch.setattr(engine, "has_accelerator", lambda: True)
    for installed, one in ((None, "mjx"), (object(), "warp")):
        monkeypatch.setattr(engine.importlib.util, "find_spec", lambda name, found=installed: found)
        assert chosen(here) == one
        assert chosen(here, "devices=2") == "mjx"


def test_auto_keeps_the_engine_of_a_run_that_was_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "has_accelerator", lambda: True)
    folder = RunFolder(compose_config([f"run_dir={tmp_path}", "engine=native"]), 0)
    folder.open()
    folder.write_config()
    assert chosen(f"run_dir={tmp_path}") != "native", "nothing was finished yet"
    (folder.checkpoints / "1").mkdir(parents=True)
    assert chosen(f"run_dir={tmp_path}") == "native"
    with pytest.raises(ConfigError, match=r"devices=2: engine=native uses the threads of one CPU"):
        chosen(f"run_dir={tmp_path}", "devices=2")
    folder.close()


def test_what_jax_was_told_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    for platforms, found in (("cpu", False), ("cuda", True), ("tpu,cpu", True)):
        monkeypatch.setattr(engine, "jax", SimpleNamespace(config=SimpleNamespace(jax_platforms=platforms)))
        assert engine.has_accelerator() == found


def test_the_script_has_every_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def rcg(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["rcg", *words])
        return rcg_jax.__main__.main()

    assert rcg() == 0
    out = capsys.readouterr().out
    for command in ("run", "evaluate", "render", "report", "export", "policies", "feasible"):
        assert f"  {command} " in out
    assert rcg("policies") == 0
    assert capsys.readouterr().out.startswith("policy ")
    assert (rcg("run", "seed=x"), rcg("fly")) == (2, 2)
    out, err = capsys.readouterr()
    assert (out, "error: fly: no such command\n" in err) == ("", True)


@pytest.mark.slow
def test_a_killed_member_of_a_plain_sweep_leaves_the_others_alone(tmp_path: Path, command: Callable) -> None:
    """As programs, as users start them."""
    head = "from rcg_jax.tasks import PointMaze\n"
    (tmp_path / "dead.py").write_text(f"{head}import os\nos.kill(os.getpid(), 9)\nclass Dead(PointMaze): ...\n")
    (tmp_path / "fine.py").write_text(f"{head}class Fine(PointMaze): ...\n")
    sweep = ("-m", "task=dead.py:Dead,fine.py:Fine", f"hydra.sweep.dir={tmp_path / 'sweep'}")
    small = ("iterations=2", "evaluation.episodes=4", "evaluation.final_episodes=5")
    run = [sys.executable, "-m", "tests.fake_run", *sweep, *small]
    done = subprocess.run(run, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode > 128
    assert "sweep: 1 of 2 runs finished" in done.stdout
    assert "killed by SIGKILL" in done.stdout
    # The same sweep into the same folder tries it again.
    (tmp_path / "dead.py").write_text(f"{head}class Dead(PointMaze): ...\n")
    done = command(*sweep, *small)
    assert (done.code, "sweep: 2 of 2 runs finished" in done.out) == (0, True), done.out
