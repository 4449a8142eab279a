"""Every example of README.md, CONTRIBUTING.md and docs/*.md: Python runs as it stands, command lines are accepted."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import pytest

from rcg_jax import __main__ as rcg
from rcg_jax import export
from rcg_jax.config.settings import ConfigError
from tests.command_lines import check

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [
    (f"{page.name}-{language or 'untagged'}-{number}", language, text)
    for page in PAGES
    for number, (language, text) in enumerate(re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.M | re.S), 1)
]
PYTHON = {name: text for name, language, text in BLOCKS if language == "python"}
LINES = [
    (f"{name}: {line.split('  ')[0].strip()}", shlex.split(line, comments=True))
    for name, language, text in BLOCKS
    if language == "sh"
    for line in text.splitlines()
    if line.strip()
]

#: Packages that examples may need and that the lock does not have.
EXTRA = ("stable_baselines3", "torch", "brax", "mujoco_playground", "gymnasium_robotics")
INSIDE = {"mujoco_playground": ["task_from_playground"], "gymnasium_robotics": ["PointMaze"]}

#: Commands that are also run, with settings that make them small. test_own_task.py runs those of examples/reacher.
SMALLER = {
    "policies": [],
    "evaluate": ["episodes=20"],
    "export": [],
    "report": ["videos=0"],
    "render": ["episodes=1", "width=160", "height=120"],
}

#: The model of docs/custom_tasks.md that the text leaves to the reader.
PEG = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="j" type="slide" axis="1 0 0" range="-1 1"
limited="true"/><geom type="sphere" size=".05" mass="1" contype="0" conaffinity="0"/><site name="peg_tip" pos=".1 0 0"/>
</body></worldbody><actuator><motor joint="j" ctrlrange="-1 1"/></actuator>
<keyframe><key name="inserted" qpos="0.2"/></keyframe></mujoco>"""

#: What an example has to lead to: the beginning of its block -> code that follows it.
AFTER = {
    "import jax\nfrom rcg_jax import make_task": "assert bool(starts.valid.all()) and starts.capacity == 200",
    "import jax\nimport jax.numpy as jnp\n\nimport rcg_jax\n\npolicy": "assert actions.shape == (10, 2)",
    "from rcg_jax import task_from_mujoco": "assert Peg('native').obs_dim == 5",
    "from rcg_jax import task_from_gymnasium": "assert Maze('native').obs_dim == 7",
    "from rcg_jax import task_from_playground": "assert Turn('native').action_dim == 2",
    '"""A planar arm': "assert Reacher('native').horizon == 250",
    "from rcg_jax.tasks.maze": "assert len(Snail('native').maze.open_centres) == 7",
    "import hashlib": "log = WandB({}, Path('runs/a/b/seed0')); log.log(1, {'success': 1.0}); log.close()",
    "import json": "assert np.linalg.norm(data.qpos - [4, 4]) < 0.3",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PYTHON)
def test_python(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = PYTHON[name]
    for package in EXTRA:
        uses = re.search(rf"^\s*(import|from) {package}\b|rcg_jax\.{package}\b", code, re.MULTILINE)
        uses = uses or any(word in code for word in INSIDE.get(package, ()))
        if uses and importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    monkeypatch.chdir(tmp_path)
    # What the text says that the example finds.
    if "import wandb" in code and importlib.util.find_spec("wandb") is None:
        monkeypatch.setitem(sys.modules, "wandb", MagicMock())
    Path("peg.xml").write_text(PEG)
    shutil.copy(ROOT / "examples" / "reacher" / "reacher.xml", tmp_path)
    if '"point_maze.npz"' in code:
        assert export.main(["task=point_maze", "out=point_maze.xml"]) == 0
        for suffix in ("npz", "json"):
            shutil.copy(ROOT / "rcg_jax" / "data" / "policies" / f"point_maze.{suffix}", tmp_path)
    file = tmp_path / "example.py"
    file.write_text(code)
    example = ModuleType("example")
    example.__dict__.update(__file__=str(file), Path=Path)
    monkeypatch.setitem(sys.modules, "example", example)  # a task's class asks where its file is
    exec(compile(code, str(file), "exec"), example.__dict__)
    exec(next((after for begin, after in AFTER.items() if code.startswith(begin)), ""), example.__dict__)


@pytest.mark.parametrize("words", [pytest.param(words, id=name) for name, words in LINES])
def test_command_line(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = " ".join(words)
    if "task=playground:" in text and importlib.util.find_spec("mujoco_playground") is None:
        pytest.skip("mujoco_playground is not installed")
    (tmp_path / "peg.xml").write_text(PEG)
    monkeypatch.chdir(tmp_path if "peg.xml" in text else ROOT)
    check(words)


@pytest.mark.parametrize(
    "line",
    [
        *("rcg trains", "rcg run tsk=ring_peg", "rcg run task=ring_pegg", "rcg evaluate episods=5"),
        *(
            "rcg run -m seed=a,b",
            "make nothing",
            'make figures ARGS="onlyy=fig2"',
            "make gpu ARGS=sseeds",
            'pip install ".[cudda]"',
        ),
        *("ls", "python -m experiments.nothing", "python -m experiments.race seeds=none", "cp rcg_jax/none.* ."),
        "python -m experiments.benchmarks.bench engine=mjx",
    ],
)
def test_a_wrong_command_line_is_noticed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises((AssertionError, ConfigError)):
        check(shlex.split(line))


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    sorted({shlex.join(words) for _, words in LINES if words[1] in SMALLER and "Reacher" not in " ".join(words)}),
)
def test_command_runs(line: str, saved: Path, gl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that take a moment, on small runs where the text has large ones."""
    words = shlex.split(line)
    for method in ("reverse", "uniform"):
        folder = Path(shutil.copytree(saved, tmp_path / "runs" / "ring_peg" / method / "seed0"))
        (folder / "metrics.csv").write_text("iteration,env_steps,success,wall_s,steps_per_s\n1,2000,0.5,1,2000\n")
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(rcg.COMMANDS[words[1]][0])
    assert module.main([*words[2:], *SMALLER[words[1]]]) == 0
    for out in (word.removeprefix("out=") for word in words if word.startswith("out=")):
        assert Path(out).stat().st_size > 0


def test_every_block_says_what_it_is() -> None:
    assert {language for _, language, _ in BLOCKS} == {"sh", "python"}
    assert all(any(code.startswith(begin) for code in PYTHON.values()) for begin in AFTER)
