"""engine=mjx against C MuJoCo on each task: the same trajectories, and the same contacts in the long run."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.io.starts_file import load_states
from rcg_jax.physics.engine import reset
from rcg_jax.physics.native import NativeEngine
from rcg_jax.tasks import Task, make_task
from tests.engine_runs import (
    BATCH,
    anywhere,
    around_the_peg,
    contact_counts,
    correlated_controls,
    on_the_way,
    trajectory,
)

made = functools.cache(make_task)


def inside_the_lock(task: Task) -> np.ndarray:
    qpos = load_states(task.feasible_file)[0]
    tip = task.snapshot(reset(jnp.asarray(qpos), jnp.zeros_like(qpos))).site_xpos[:, task.model.site("tip").id]
    inside = qpos[np.asarray(tip)[:, 2] < -0.55]
    return inside[np.random.default_rng(0).choice(len(inside), BATCH, replace=False)]


def at_walls(task: Task) -> np.ndarray:
    """Balls at random, half of them where a wall already pushes."""
    starts = np.asarray(task.sample_feasible(jax.random.key(2), 8 * BATCH).qpos)
    touching = np.asarray(jax.vmap(task.maze.clearance)(starts)) < 0.2
    return np.concatenate([starts[touching][: BATCH // 2], starts[~touching][: BATCH // 2]])


def without(*pairs: str) -> Callable[[Task], mujoco.MjModel]:
    """The task's model without the contacts of these geoms."""

    def maimed(task: Task) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_file(str(task.xml))
        for pair in [p for p in spec.pairs if {*pairs} <= {p.geomname1, p.geomname2}]:
            spec.delete(pair)
        return spec.compile()

    return maimed


def softer(task: Task) -> mujoco.MjModel:
    model = task.make_model()
    model.pair_solref[:, 0] *= 2
    return model


@dataclass(frozen=True)
class Case:
    """Starts and controls of a task.

    Attributes:
        most: how far apart positions may be in the median and in all but two environments, and velocities in these.
        touching: the least share of steps with a contact; without, there is nothing to disagree on.
        wrong: a model that a comparison of contacts in the long run has to notice.
    """

    task: str
    starts: Callable[[Task], np.ndarray]
    scale: float = 1.0
    steps: int = 20
    most: tuple[float, float, float] = (2e-6, 2e-5, 1e-3)
    touching: float = 0.1
    wrong: Callable[[Task], mujoco.MjModel] | None = None


CASES = [
    Case("ring_peg", around_the_peg),
    Case("ring_peg", anywhere),
    Case("point_maze", at_walls, scale=2, steps=50, most=(1e-6, 5e-5, 5e-4), touching=0.2),
    Case("ant_maze", on_the_way, scale=150, most=(1e-5, 1e-4, 5e-3), touching=0.3),
    Case("key_insertion", around_the_peg),
    Case("key_insertion", inside_the_lock),
    Case("key_insertion", anywhere),
]


def cases(chosen: list[Case]) -> list:
    """The key's are slow."""
    slow = pytest.mark.slow
    return [
        pytest.param(one, id=f"{one.task} {one.starts.__name__}", marks=slow if one.task == "key_insertion" else ())
        for one in chosen
    ]


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(CASES))
def test_short_trajectories(case: Case) -> None:
    tasks = [made(case.task, engine) for engine in ("native", "mjx")]
    assert tasks[1].engine.solves_contacts  # type: ignore[attr-defined]
    qpos, model = case.starts(tasks[0]), tasks[0].model
    controls = case.scale * correlated_controls(case.steps, BATCH, model.nu, seed=1)
    native, mjx = (trajectory(task.engine, qpos, controls) for task in tasks)
    assert np.mean(contact_counts(model, native[0]) > 0) > case.touching
    positions, velocities = (np.abs(a - b).max((0, 2)) for a, b in zip(native, mjx))
    # A contact that jumps to another edge one step later is no disagreement: allow two environments.
    assert np.median(positions) < case.most[0]
    assert np.sort(positions)[-3] < case.most[1]
    assert np.sort(velocities)[-3] < case.most[2]


def deviation(task: Task, a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference between two sets of trajectories (T, B, nq) from the same starts, in standard errors.

    Compared are, per environment: the mean number of contacts, the share of steps with any contact, and the mean and
    final distance to the goal. The pairs of environments are independent, so the mean of B differences has a standard
    error of sd / sqrt(B); 4 of them in any of four statistics happen by chance once in 4,000.
    """
    largest = 0.0
    statistics = []
    for q in (a, b):
        contacts = contact_counts(task.model, q[::4])
        flat = jnp.asarray(q[::4].reshape(-1, q.shape[-1]))
        s = task.snapshot(reset(flat, jnp.zeros((len(flat), task.model.nv))))
        distance = np.asarray(jax.vmap(task.distance)(s)).reshape(contacts.shape)
        statistics.append((contacts.mean(0), (contacts > 0).mean(0), distance.mean(0), distance[-1]))
    for x, y in zip(*statistics):
        difference = x - y
        largest = max(largest, abs(difference.mean()) / (difference.std(ddof=1) / np.sqrt(len(difference)) + 1e-9))
    return largest


LONG = [
    Case("ring_peg", around_the_peg, steps=200, wrong=without("peg", "ring_near")),
    Case("point_maze", at_walls, scale=2, steps=300, wrong=softer),
    Case("ant_maze", on_the_way, scale=150, steps=150),
    Case("key_insertion", around_the_peg, steps=200, wrong=without("lock_bar")),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(LONG))
def test_contacts_in_the_long_run(case: Case) -> None:
    """Not the same actions: what must agree is the distribution."""
    native, mjx = (made(case.task, engine) for engine in ("native", "mjx"))
    qpos = case.starts(native)
    first, second = (case.scale * correlated_controls(case.steps, BATCH, native.model.nu, seed=seed) for seed in (3, 4))
    path = trajectory(native.engine, qpos, first)[0]
    assert deviation(native, path, trajectory(mjx.engine, qpos, second)[0]) < 4.0
    if case.wrong:
        wrong = NativeEngine(case.wrong(native))
        assert deviation(native, path, trajectory(wrong, qpos, second)[0]) > 5.0
