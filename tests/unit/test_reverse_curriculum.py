"""The curriculum as an object: what it proposes, what it makes of reports, and that it can be saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcg_jax import ReverseCurriculum
from rcg_jax.config.settings import ConfigError
from rcg_jax.gymnasium import make_vec
from rcg_jax.methods.reverse_curriculum import Starts
from tests.analytic import Line

SMALL = ["curriculum.num_new=20", "curriculum.num_old=10", "curriculum.num_candidates=200"]


def make(seed: int = 0, episodes: int | None = None, settings: Any = (), **task: Any) -> ReverseCurriculum:
    line = Line(horizon=40, feasible_radius=5.0, **task)
    line.engine.fusion_emitters = True
    return ReverseCurriculum(line, seed=seed, episodes=episodes, settings=[*SMALL, *settings])


def reach(starts: Starts) -> np.ndarray:
    """How far each start is from the goal."""
    return np.abs(starts.qpos[:, 0])


def test_proposes_each_start_equally_often() -> None:
    curriculum = make()
    assert curriculum.starts.capacity == 30
    _, counts = np.unique(curriculum.propose(60).row, return_counts=True)
    assert set(counts) == {2}
    starts = curriculum.propose(7)
    np.testing.assert_array_equal(starts.qpos, np.asarray(curriculum.starts.qpos)[starts.row])
    assert (starts.qvel == 0).all()


def test_grows_outwards_where_everything_near_is_mastered() -> None:
    """An oracle that solves what is within its reach, and whose reach grows."""
    curriculum, rng = make(gain=0.01), np.random.default_rng(0)
    furthest = []
    for radius in (0.2, 0.5, 1.0, 1.5):
        for _ in range(4):
            starts = curriculum.propose(120)
            assert curriculum.report(starts, rng.random(120) < np.clip(radius - reach(starts) + 0.5, 0, 1))
        furthest.append(reach(curriculum.propose(60)).max())
    assert curriculum.iteration == 16
    assert furthest[0] < 0.8 < 1.2 < furthest[-1]


def test_good_starts_become_seeds_and_are_remembered() -> None:
    curriculum = make()
    starts = curriculum.propose(120)
    outcome = starts.row % 2 == 0  # constant for each start: all are mastered or too hard, none is good
    first = np.flatnonzero(starts.row == 4)
    outcome[first[::2]] = False  # but one, half of whose episodes succeed
    curriculum.report(starts, outcome)
    assert curriculum.metrics["share_good"] == pytest.approx(1 / 30)
    assert curriculum.metrics["labelled"] == 1


def test_nothing_is_learned_from_starts_of_an_earlier_iteration() -> None:
    curriculum = make(episodes=30)
    late = curriculum.propose(30)
    assert curriculum.report(curriculum.propose(30), np.ones(30))
    assert not curriculum.report(late, np.zeros(30))
    assert curriculum.iteration == 1
    assert not curriculum.report(curriculum.propose(29), np.ones(29))


def test_goes_on_from_a_file_exactly(tmp_path: Path) -> None:
    def go_on(curriculum: ReverseCurriculum, rounds: int) -> list[np.ndarray]:
        seen = []
        for _ in range(rounds):
            starts = curriculum.propose(50)
            seen.append(starts.qpos)
            curriculum.report(starts, reach(starts) < 0.3, np.full(50, 7))
        return seen

    curriculum = make()
    go_on(curriculum, 5)  # in the middle of an iteration
    curriculum.save(tmp_path / "state.npz")
    expected = go_on(curriculum, 5)
    other = make(seed=9)
    other.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(go_on(other, 5), expected)
    with pytest.raises(ValueError, match="other settings"):
        make(settings=["curriculum.num_old=11"]).load(tmp_path / "state.npz")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["curriculum.rho_0_share=0.5"], "rho_0_share"),
        (["method=uniform"], "method=uniform: must be reverse or all_starts"),
        (["curriculum.num_new=0"], "curriculum.num_new"),
        (["trpo.gamma=0.9"], "trpo.gamma: must be a setting curriculum"),
    ],
)
def test_refused_settings(settings: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(settings=settings)


@pytest.mark.slow
def test_refused_numbers() -> None:
    curriculum = make()
    with pytest.raises(ValueError, match="n=0"):
        curriculum.propose(0)
    with pytest.raises(ValueError, match="successes: must have the shape"):
        curriculum.report(curriculum.propose(4), np.ones(5))
    with pytest.raises(ValueError, match="episodes=0"):
        make(episodes=0)


def test_a_vector_environment_reports_as_many_episodes_of_every_environment() -> None:
    curriculum = make(episodes=24, gain=0.05, goal_radius=0.05)
    env = make_vec(curriculum.task, 8, curriculum=curriculum, action_repeat=1)
    told: list[Starts] = []
    report = curriculum.report

    def listen(starts: Starts, successes: np.ndarray, steps: np.ndarray | None = None) -> bool:
        told.append(starts)
        assert len(successes) == 24
        assert (np.asarray(steps)[successes] <= 40).all()
        return report(starts, successes, steps)

    curriculum.report = listen  # type: ignore[method-assign]
    obs, _ = env.reset(seed=0)
    while curriculum.iteration < 2:
        obs, *_ = env.step(-np.sign(obs[:, :1]) * 0.5)
        np.testing.assert_array_equal(env.starts.qpos, curriculum.starts.qpos)
    assert [starts.iteration for starts in told] == [0, 1]
    with pytest.raises(ValueError, match="only one of them"):
        make_vec(curriculum.task, 8, curriculum=curriculum, starts=curriculum.starts)
    with pytest.raises(ValueError, match="curriculum: is of task line"):
        make_vec("point_maze", 8, curriculum=curriculum)


def test_an_environment_follows_a_curriculum_that_goes_on_elsewhere(tmp_path: Path) -> None:
    curriculum = make(episodes=30, gain=0.05)
    env = make_vec(curriculum.task, 8, curriculum=curriculum, action_repeat=1)
    env.reset(seed=0)
    curriculum.save(tmp_path / "state.npz")
    assert curriculum.report(curriculum.propose(30), np.ones(30))
    env.step(np.zeros((8, 1), np.float32))
    assert env.starts is curriculum.starts
    curriculum.load(tmp_path / "state.npz")
    env.reset()
    assert env.starts is curriculum.starts
    assert curriculum.iteration == 0
    with pytest.raises(ValueError, match="come from the curriculum"):
        env.set_starts(curriculum.starts)


@pytest.mark.parametrize("content", [b"", b"junk", None])
def test_damaged_files_are_refused(content: bytes | None, tmp_path: Path) -> None:
    curriculum, path = make(), tmp_path / "state.npz"
    curriculum.save(path)
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    with pytest.raises(ValueError, match="is no file of a curriculum, or damaged"):
        curriculum.load(path)
    with pytest.raises(ValueError, match="true or false"):
        curriculum.report(curriculum.propose(2), np.array([0.2, 0.7]))


def test_new_starts_are_spread_over_the_trainers_values() -> None:
    """V changes in a twentieth of what the walks visit only: spread over V, nearly all new starts lie there."""
    border = []

    def value(obs: np.ndarray) -> np.ndarray:
        border.append(np.quantile(np.abs(obs[:, 0]), 0.95))
        return np.maximum(np.abs(obs[:, 0]), border[-1])

    line = Line(horizon=40, feasible_radius=5.0, gain=0.01)
    line.engine.fusion_emitters = True
    curriculum = ReverseCurriculum(line, value=value, settings=[*SMALL, "curriculum.value_share=1"])
    new = np.abs(np.asarray(curriculum.starts.qpos)[:20, 0])
    assert np.sum(new >= border[0]) >= 10


def test_refused_values() -> None:
    line = Line(horizon=40, feasible_radius=5.0)
    line.engine.fusion_emitters = True
    with pytest.raises(ConfigError, match=r"curriculum\.value_share: needs value"):
        ReverseCurriculum(line, settings=["curriculum.value_share=1"])
    with pytest.raises(ConfigError, match=r"value: needs curriculum\.selection=spread"):
        ReverseCurriculum(line, value=lambda obs: obs[:, 0], settings=["curriculum.selection=random"])
    with pytest.raises(Exception, match="value: returned NaN"):
        np.asarray(ReverseCurriculum(line, value=lambda obs: obs[:, 0] * np.nan, settings=SMALL).starts.qpos)
    with pytest.raises(Exception, match=r"value: must return \(230,\)"):
        np.asarray(ReverseCurriculum(line, value=lambda obs: obs, settings=SMALL).starts.qpos)


def test_a_custom_task_is_checked_before_anything_compiles(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("from rcg_jax.tasks import PointMaze\n\nclass Mine(PointMaze):\n    horizon = 2.5\n")
    for use in (ReverseCurriculum, lambda task: make_vec(task, 2)):
        with pytest.raises(ConfigError, match=r"horizon = 2\.5: must be an integer >= 1"):
            use(f"{file}:Mine")


def test_reports_of_other_starts_are_refused() -> None:
    curriculum = make()
    starts, solved = curriculum.propose(5), np.ones(5, bool)
    for wrong, says in (
        (lambda: curriculum.report(starts._replace(row=starts.row - 30), solved), "rows must be 0 to 29"),
        (lambda: curriculum.report(starts, solved, np.full(5, -3)), "steps: must be numbers >= 0"),
        (lambda: curriculum.report(starts, solved, np.full(5, np.nan)), "steps: must be numbers >= 0"),
        (lambda: curriculum.report(starts.qpos, solved), "must be those that propose gave"),  # type: ignore[arg-type]
    ):
        with pytest.raises(ValueError, match=says):
            wrong()
