"""The race: what counts as reached, its table, and the one evaluator."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.race import __main__ as race
from experiments.race.__main__ import crossings
from experiments.race.report import table
from experiments.race.snapshots import name, snapshots, success
from rcg_jax.gymnasium import make_vec

CURVE = [
    {"seconds": "60", "env_steps": "1000", "stochastic": "0.2", "mean": "0.95"},
    {"seconds": "90", "env_steps": "2000", "stochastic": "0.5", "mean": "0.5"},
    {"seconds": "120", "env_steps": "3000", "stochastic": "0.4", "mean": "0.5"},
]


def test_a_level_is_reached_by_the_first_snapshot_of_the_stochastic_policy() -> None:
    assert crossings(CURVE) == {
        "minutes_to_0.45": "1.50",
        "steps_to_0.45": "2000",
        "minutes_to_0.9": "",
        "steps_to_0.9": "",
    }


def row(seed: int, **cells: Any) -> dict[str, str]:
    usual = {"task": "ring_peg", "trainer": "ours", "seed": seed, "version": "1", "minutes": 5, "minutes_to_0.45": 1}
    usual |= {"minutes_to_0.9": 2, "steps_to_0.9": 3e6, "success_stochastic": 0.9, "success_mean": 0.95}
    return {key: str(value) for key, value in (usual | cells).items()}


def test_the_table_has_medians_in_which_a_missed_level_is_infinite() -> None:
    rows = [row(0), row(1, **{"minutes_to_0.9": "", "steps_to_0.9": ""}), row(2, **{"minutes_to_0.9": 4})]
    rows += [row(0, trainer="ppo", **{"minutes_to_0.9": "", "steps_to_0.9": ""})]
    ours, ppo = table(rows).splitlines()[2:]
    assert "| 4.0 (2.0 to not reached) |" in ours
    assert "| 3 |" in ours
    assert "| not reached | not reached |" in ppo


def test_snapshots_are_found_by_time(tmp_path: Path) -> None:
    (tmp_path / name(1000.04, 5_000_000)).mkdir()
    (tmp_path / f"{name(99.5, 70)}.pickle").touch()
    assert [(each.seconds, each.env_steps) for each in snapshots(tmp_path)] == [(99.5, 70), (1000.0, 5_000_000)]


def test_success_counts_the_first_episode_of_each_start() -> None:
    """Without force the ball stays where it is: at the goal it succeeds in its first step, elsewhere never."""
    env = make_vec("point_maze", 10)
    qpos, starts = np.tile(env.task.goal_state, (10, 1)), np.asarray(env.starts.qpos)
    qpos[::2] = starts[np.linalg.norm(starts - env.task.goal_state, axis=1) > 3.0][:5]

    def still(obs: np.ndarray, mean: bool) -> np.ndarray:
        assert mean
        return np.zeros((10, 2), np.float32)

    assert success(env, still, qpos, mean=True) == pytest.approx(0.5)


def test_a_row_that_was_trained_is_scored_only_and_with_other_settings_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = []

    def train(command: Sequence[str], folder: Path, minutes: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        trained.append(command)

    def score(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(race, "_train", train)
    monkeypatch.setattr(subprocess, "run", score)
    for words, runs in (("every=4", 1), ("every=4", 1), ("every=5", 2)):
        chosen = race.RaceOptions(folder=str(tmp_path), words=words)
        with pytest.raises(KeyboardInterrupt):
            race._run(chosen, "ring_peg", "ours", 0, tmp_path / "race.csv")
        assert len(trained) == runs
