"""The documented example of a start-state method of one's own, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rcg_jax.config import compose as cli
from rcg_jax.config.settings import Config, ConfigError, CurriculumConfig
from rcg_jax.io.tables import read_csv
from rcg_jax.methods import make_method
from rcg_jax.methods.base import MethodMetrics
from rcg_jax.tasks import Task
from rcg_jax.types import StartLabels
from tests import report_run
from tests.real_run import train

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = f"{REPOSITORY}/examples/growing_radius.py:GrowingRadius"
CONFIG = Config(curriculum=CurriculumConfig(num_new=30, num_old=10))


#: A method that breaks the contract in the last line of propose.
BODY = """import jax.numpy as jnp
GOAL = lambda task: task.goal_starts()
class M:
    def __init__(self, task, config): self.task = task
    def init(self, key): return jnp.zeros(())

    def propose(self, key, state, agent):
        return 0.0

    def update(self, key, state, starts, labels): return state, None
"""


@pytest.fixture(scope="module")
def task(ring_peg_native: Task) -> Task:
    return ring_peg_native


@pytest.mark.slow
def test_the_example_proposes_near_starts_and_grows_with_success(task: Task) -> None:
    method = make_method(NAME, task, CONFIG)
    radius = method.init(jax.random.key(0))
    propose, update = jax.jit(lambda k, r: method.propose(k, r, None)), jax.jit(method.update)
    distances = []
    for i in range(8):
        radius, starts = propose(jax.random.key(i), radius)
        assert starts.capacity == 40
        assert np.all(starts.valid)
        distance = np.asarray(jax.vmap(task.distance)(task.snapshot(task.reset(starts))))
        assert distance.max() <= float(radius) + 1e-4
        distances.append(distance.mean())
        rate = 10 if i < 6 else 5
        labels = StartLabels(*(np.full(40, x) for x in (rate, 10, 7)))
        before = float(radius)
        radius, metrics = update(jax.random.key(i), radius, starts, labels)
        assert isinstance(metrics, MethodMetrics)
        assert (float(radius) > before) == (i < 6)
    assert distances[6] > 1.5 * distances[0]


@pytest.mark.slow
def test_a_run_with_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """The documented words, with tiny settings: trains two seeds in folders of the class's name, resumes, reports."""
    monkeypatch.chdir(REPOSITORY)
    words = ["method=examples/growing_radius.py:GrowingRadius", "task=point_maze", "engine=native", "num_seeds=2"]
    words += ["evaluation.final_episodes=50", "trpo.iterations=1", "rollout.num_envs=4"]
    train(tmp_path, *words, "iterations=1")
    train(tmp_path, *words, "iterations=2", "write_report=true")
    said = capsys.readouterr()
    assert "resuming from iteration 1 of 2" in said.out + said.err
    for seed in (0, 1):
        folder = tmp_path / "point_maze" / "GrowingRadius" / f"seed{seed}"
        found = report_run.content(folder / "report.html")
        assert found["starts"]["iterations"] == [1, 2]
        assert found["final"]["all"]["rate"] == pytest.approx(float(read_csv(folder / "eval.csv")[1][-1][2]))
        assert found["final"]["all"]["episodes"] == 50


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("class M:\n    def init(self, key): ...\n", r"M has no propose, update"),
        ("M = 3\n", "M is no class"),
        ("class M:\n    init = propose = update = print\n", r"TypeError: .*takes no arguments"),
        (BODY, r"propose must return \(state, StartSet\), not float32"),
        (BODY.replace("return 0.0", "return state, 3"), r"propose must return \(state, StartSet\), not \(float32"),
        (BODY.replace("return 0.0", "return 1 / 0"), r"ZeroDivisionError: division by zero \(own.py, line 8\)"),
        (
            BODY.replace("return 0.0", "return state, GOAL(self.task)"),
            r"update must return .*, not \(float32\(\), None\)",
        ),
        (
            BODY.replace("return 0.0", "return jnp.zeros(3), GOAL(self.task)"),
            r"propose changes a part of the state from float32\(\) to float32\(3,\)",
        ),
        ("class M:\n  def x(:\n", "line 2"),
        ("raise RuntimeError('no')\nclass M: ...\n", "importing .* failed, line 1: RuntimeError: no"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(task: Task, tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "own.py"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"method={path}:M: .*{said}") as error:
        make_method(f"{path}:M", task, CONFIG)
    assert "\n" not in str(error.value)


def test_the_command_line_refuses_before_anything_is_imported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"method=nope: must be one of reverse, .* or a class of your own"):
        cli.compose_config(["method=nope"])
    with pytest.raises(ConfigError, match=r"method=/none.py:M: no such file"):
        cli.compose_config(["method=/none.py:M"])
    assert cli.compose_config([f"method={NAME}"]).method == NAME
