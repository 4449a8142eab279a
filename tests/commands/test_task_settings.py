"""Settings that a task trains with, between the defaults and what the user says; ``training`` of a custom class."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from rcg_jax import run
from rcg_jax.config.compose import compose_config
from rcg_jax.config.names import TASKS
from rcg_jax.config.presets import PRESETS
from rcg_jax.config.presets import TASK_SETTINGS as SETTINGS
from rcg_jax.config.settings import Config, flatten
from rcg_jax.runs.settings import differences, read_values
from rcg_jax.tasks import AntMaze, RingPeg, register_task, task_class
from rcg_jax.tasks.training import task_settings, training_config

SMALL = ("iterations=2", "evaluation.episodes=4", "evaluation.final_episodes=5")

#: What RingPeg, and every class that extends it, trains with.
INHERITED = {"policy.action_repeat": 4}


def changed(words: list[str]) -> dict[str, object]:
    """What differs from composition without the task's class."""
    plain, asked = compose_config(words), training_config(words)
    return {name: new for (name, _, old), (_, _, new) in zip(flatten(plain), flatten(asked)) if old != new}


def mine(folder: Path, training: str) -> str:
    file = folder / "mine.py"
    file.write_text(f"from rcg_jax.tasks import RingPeg\n\nclass Mine(RingPeg):\n    training = {training}\n")
    return f"task={file}:Mine"


def test_the_task_wins_over_the_defaults_and_the_user_over_the_task(tmp_path: Path) -> None:
    word = mine(tmp_path, "{'trpo.max_kl': 0.03, 'baseline.hidden': [8, 8], 'rollout.batch_size': 30_000}")
    asked = {"trpo.max_kl": 0.03, "baseline.hidden": [8, 8], "rollout.batch_size": 30_000}
    assert changed([word]) == INHERITED | asked
    # The user's word counts where it says what the defaults say, too.
    config = training_config([word, "trpo.max_kl=0.01"])
    assert (config.trpo.max_kl, config.baseline.hidden) == (0.01, [8, 8])
    assert training_config([word, "preset=default"]).trpo.max_kl == 0.03
    assert changed([word, "preset=paper"]) == {}
    config.baseline.hidden.append(9)
    assert training_config([word]).baseline.hidden == [8, 8], "lists are not shared"


def test_a_class_adds_to_what_the_classes_that_it_extends_train_with(tmp_path: Path) -> None:
    @register_task
    class Calmer(AntMaze):
        training: ClassVar = {"policy.init_std": 0.25, "trpo.gamma": 0.99}

    @register_task
    class Same(Calmer): ...

    @register_task
    class Bolder(Same):
        training: ClassVar = {"trpo.max_kl": 0.1}

    calmer = task_settings("ant_maze") | {"policy.init_std": 0.25, "trpo.gamma": 0.99}
    assert task_settings("Calmer") == task_settings("Same") == calmer
    assert task_settings("Bolder") == calmer | {"trpo.max_kl": 0.1}
    file = tmp_path / "mixed.py"
    file.write_text(
        "from rcg_jax.tasks import PointMaze, RingPeg\n\n"
        "class Tuned:\n    training = {'trpo.max_kl': 0.05}\n\n"
        "class Mine(Tuned, RingPeg): ...\n\n"
        "class Other(PointMaze):\n    name = 'ant_maze'\n"
    )
    assert task_settings(f"{file}:Mine") == INHERITED | {"trpo.max_kl": 0.05}
    assert task_settings(f"{file}:Other") == {}, "names alone do not count"


def test_numbers_of_numpy_and_tuples_are_numbers_and_lists() -> None:
    @register_task
    class Numbers(RingPeg):
        training: ClassVar = {
            "trpo.max_kl": np.float32(0.5),
            "trpo.iterations": np.int64(3),
            "trpo.gae_lambda": 1,
            "policy.learn_std": np.bool_(False),
            "policy.hidden": (8, np.int32(9)),
            "baseline.hidden": np.array([7]),
        }

    values = task_settings("Numbers")
    assert values.pop("policy.action_repeat") == 4
    assert list(values.values()) == [0.5, 3, 1.0, False, [8, 9], [7]]
    assert [type(value) for value in values.values()] == [float, int, float, bool, list, list]
    assert {type(value) for value in values["policy.hidden"]} == {int}


@pytest.mark.parametrize(
    ("training", "parts"),
    [
        ("['trpo.max_kl']", ["training is a list", "dict"]),
        ("{'trpo.delta': 1}", ["training: trpo.delta must be the dotted name of a setting", "curriculum"]),
        ("{'seed': 1}", ["training: seed must be the dotted name of a setting"]),
        ("{7: 1}", ["training: 7 must be the dotted name"]),
        ("{'trpo.max_kl': '0.02'}", ["training: trpo.max_kl='0.02': must be a number > 0"]),
        ("{'trpo.max_kl': True}", ["training: trpo.max_kl=True: must be a number > 0"]),
        ("{'policy.learn_std': 1}", ["training: policy.learn_std=1: must be true or false"]),
        ("{'trpo.iterations': 2.5}", ["training: trpo.iterations=2.5: must be an integer"]),
        ("{'baseline.hidden': [[1]]}", ["training: baseline.hidden=[[1]]: must be a list of integers"]),
        ("{'trpo': {'max_kl': 1}}", ["training: trpo must be the dotted name of a setting, such as trpo.max_kl"]),
        ("{'trpo.max_kl': -1}", ["trpo.max_kl=-1", "> 0", "training of task="]),
        ("{'curriculum.r_min': 0.95}", ["curriculum.r_min=0.95: must be below curriculum.r_max", "training of task="]),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], training: str, parts: list[str]
) -> None:
    word = mine(tmp_path, training)
    assert run.main([word, f"run_dir={tmp_path / 'runs'}"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for part in (f"{tmp_path}/mine.py:Mine", *parts):
        assert part in said
    assert not (tmp_path / "runs").exists()


def test_each_run_is_trained_with_them_and_another_class_does_not_go_on(tmp_path: Path, command: Callable) -> None:
    word = mine(tmp_path, "{'trpo.max_kl': 0.03, 'trpo.gamma': 0.9}")
    done = command("-m", "trpo.gae_lambda=0.5,0.6", word, "trpo.gamma=0.99", *SMALL)
    assert done.code == 0, done.err
    assert "set by the task: policy.action_repeat=4, trpo.max_kl=0.03\n" in done.out
    for value in (0.5, 0.6):
        values = read_values(tmp_path / f"runs/trpo.gae_lambda-{value}/Mine/reverse/seed0/config.yaml")
        names = ("trpo.max_kl", "trpo.gamma", "policy.action_repeat", "trpo.gae_lambda")
        assert [values[name] for name in names] == [0.03, 0.99, 4, value]
    task_class(word.removeprefix("task=")).training = {"trpo.max_kl": 0.04}
    words = (word, "trpo.gae_lambda=0.5", "trpo.gamma=0.99", "run_dir=runs/trpo.gae_lambda-0.5", *SMALL)
    done = command(*words)
    assert done.code == 2
    assert "trpo.max_kl 0.03 -> 0.04 (trpo.max_kl: as the task now sets)" in done.err
    assert command(*words, "trpo.max_kl=0.03").code == 0  # as the refusal says


def test_a_size_that_was_given_is_not_lost_when_the_run_continues(command: Callable) -> None:
    assert command("rollout.num_envs=50", *SMALL).code == 0
    done = command(*SMALL)
    assert done.code == 2
    assert "rollout.num_envs 50 -> " in done.err


#: The command line; instead of a run, how many devices there are.
COUNT = """
import sys
from rcg_jax import run
from rcg_jax.runs import train as loop

def count(config, **_):
    import jax
    print(jax.local_device_count(), config.trpo.max_kl)

loop.run = count
sys.exit(run.main())
"""


def test_a_file_that_computes_when_it_is_imported_may_use_several_devices(tmp_path: Path) -> None:
    word = mine(tmp_path, "{'trpo.max_kl': 0.03}")
    (tmp_path / "mine.py").write_text(f"import jax\n\njax.numpy.zeros(2)\n{(tmp_path / 'mine.py').read_text()}")
    done = subprocess.run(
        [sys.executable, "-c", COUNT, word, "devices=3", "engine=mjx"],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "3 0.03\n"), done.stderr


@pytest.mark.parametrize("task", TASKS)
def test_what_the_tasks_of_the_paper_ask_for_can_be_used(task: str) -> None:
    config = training_config([f"task={task}"])
    values = {name: value for name, _, value in flatten(config)}
    assert {name: values[name] for name in task_settings(task)} == task_settings(task)
    assert training_config([f"task={task}", "preset=paper"]) == compose_config([f"task={task}", "preset=paper"])
    # A run of before a class asked for it does not go on silently.
    old = {name: value for name, _, value in flatten(compose_config([f"task={task}"]))}
    assert {line.split()[0] for line in differences(old, config)} == set(task_settings(task))


def test_presets_and_tasks_set_settings_that_there_are() -> None:
    names = {name for name, _, _ in flatten(Config())}
    for table in (*PRESETS.values(), *SETTINGS.values()):
        assert table.keys() <= names
    assert SETTINGS.keys() <= set(TASKS)
