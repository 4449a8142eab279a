"""S^0 of a task without an exact sampler: SampleNearby from [s^g] with very large M and long T_B (appendix A.2).

Procedure 1 as it stands, in rounds of many walks: each walk begins at rest in a state drawn uniformly from all
states collected so far. The collected states are thinned to one per cell of a grid of positions.

Where S^0 is long and narrow, as a maze is, that procedure hardly gets on: most of what was collected lies near the
goal state, so most walks begin there, and the distance covered grows with the logarithm of the walks. Walks from states
drawn uniformly from the thinned starts so far (``seeds="starts"``) advance at a constant pace, and so fill a maze.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.config.settings import ConfigError
from rcg_jax.curriculum.sample_nearby import brownian_walks
from rcg_jax.curriculum.settle import settle
from rcg_jax.physics.jit import jit
from rcg_jax.physics.kinematics import quaternions
from rcg_jax.physics.silence import silence
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartSet

#: What walks begin in, see :func:`search`.
SEEDS = ("visited", "starts")

_CHUNK = 1024  # states that settle side by side


@dataclass(frozen=True)
class Round:
    """The state of the search after one round of walks.

    Attributes:
        rows: (K, nq + na) float32, the thinned and checked starts so far, in the order in which they were found; see
            :func:`to_rows`.
        visited: M, states collected so far.
        walks: walks so far.
        rejected: first visitors of a cell that a check refused so far (their cell stays open).
        fresh: starts that this round added.
    """

    rows: np.ndarray
    visited: int
    walks: int
    rejected: int
    fresh: int


def to_rows(starts: StartSet) -> np.ndarray:
    """Starts at rest as one array (C, nq + na) of positions and, where the model has any, activations."""
    return np.hstack([np.asarray(x) for x in (starts.qpos, starts.act) if x is not None])


def from_rows(task: Task, rows: Array) -> StartSet:
    """The starts at rest that :func:`to_rows` made rows of; rows of positions alone get neutral activations."""
    nq = task.model.nq
    return task.at_rest(rows[:, :nq], rows[:, nq:] if task.model.na and rows.shape[1] > nq else None)


def canonical_quaternions(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Positions (K, nq) where of the two quaternions of an orientation, q and -q, always the same one stands."""
    qpos = np.array(qpos)
    for place in quaternions(model).values():
        quat = qpos[:, place]
        leading = np.take_along_axis(quat, np.argmax(quat != 0, axis=1)[:, None], axis=1)
        quat *= np.where(leading < 0, -1, 1)
    return qpos


def cells(coordinates: np.ndarray, grid: float) -> np.ndarray:
    """Grid cells (K, d) int64 of coordinates (K, d), edge length ``grid`` [rad, m]."""
    return np.floor(coordinates.astype(np.float64) / grid).astype(np.int64)


def clearance(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Smallest contact distance (K,) [m] of positions (K, nq): negative inside each other, inf without contact.

    C MuJoCo's collisions in float64, whatever engine the walks ran on.
    """
    data = mujoco.MjData(model)
    distance = np.full(len(qpos), np.inf)
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        try:
            with silence():
                mujoco.mj_collision(model, data)
        except mujoco.FatalError:  # more contacts than it has room for
            distance[i] = -np.inf
            continue
        if data.ncon:
            distance[i] = data.contact.dist.min()
    return distance


def limit_excess(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """How far (K,) [rad, m] positions (K, nq) are beyond the joints' ranges; negative within all of them."""
    scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    joints = np.flatnonzero(model.jnt_limited.astype(bool) & scalar)
    if not len(joints):
        return np.full(len(qpos), -np.inf)
    x = qpos[:, model.jnt_qposadr[joints]]
    low, high = model.jnt_range[joints].T
    return np.maximum(low - x, x - high).max(axis=1)


def make_settle(task: Task, steps: int) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function that lets states go at rest under their neutral action for ``steps`` physics steps.

    It takes rows of :func:`to_rows`, or positions alone (K, nq).

    Returns:
        Function giving (stays (K,) bool: feasible, not failed and finite all the time; drift (K,): largest change
        of one of the task's grid coordinates [rad, m]).
    """

    @jit
    def let_go(rows: Array) -> tuple[Array, Array]:
        return settle(task, from_rows(task, rows), steps)

    return functools.partial(_by_chunks, let_go)


def make_compositions(task: Task) -> Callable[[np.ndarray], tuple[dict[str, np.ndarray], np.ndarray]]:
    """A function of states: rows of :func:`to_rows`, or positions alone (K, nq).

    Returns:
        Function giving (which of the task's named subsets each is in, {name: (K,) bool}; distances (K,) [m]).
    """

    @jit
    def evaluate(rows: Array) -> tuple[dict[str, Array], Array]:
        s = task.snapshot(task.reset(from_rows(task, rows)))
        return jax.vmap(task.composition)(s), jax.vmap(task.distance)(s)

    return functools.partial(_by_chunks, evaluate)


def _by_chunks(fun: Callable[[Array], Any], rows: np.ndarray) -> Any:
    """``fun`` of K >= 0 rows, computed for a fixed number at a time: one shape, one compilation."""
    parts = []
    for i in range(0, max(len(rows), 1), _CHUNK):
        padded = np.zeros((_CHUNK, rows.shape[1]), np.float32)
        part = rows[i : i + _CHUNK]
        padded[: len(part)] = part
        parts.append(fun(jnp.asarray(padded)))
    return jax.tree.map(lambda *xs: np.concatenate(xs)[: len(rows)], *parts)


def search(
    task: Task,
    *,
    seed: int,
    num_walks: int,
    walk_length: int,
    noise_std: float,
    noise: str,
    seeds: str = "visited",
    grid: float,
    max_depth: float,
    max_excess: float,
    max_drift: float,
    settle_steps: int,
) -> Iterator[Round]:
    """Collects feasible starts without end; the caller takes rounds until it has enough.

    A start is kept if it is the first visitor of its grid cell (in its round, by time of the walk) and passes the
    checks: nothing overlaps by more than ``max_depth`` [m], no joint is more than ``max_excess`` [rad, m] beyond its
    range, and under ``settle_steps`` steps of its neutral action from rest it stays feasible and finite and moves by at
    most ``max_drift`` [rad, m] in the task's grid coordinates. Walks, too, begin only in states that pass the first
    two checks. A quaternion and its negative are one orientation, so in one cell.

    Args:
        task: task and physics.
        seed: of all randomness; the same seed gives the same rounds.
        num_walks: walks per round, side by side.
        walk_length: T_B [physics steps].
        noise_std, noise: see :func:`rcg_jax.curriculum.sample_nearby.brownian_walks`.
        seeds: ``visited``: walks begin in states drawn uniformly from all those visited, as in Procedure 1;
            ``starts``: from those kept so far (at first the goal state), so that a region where walks linger does
            not breed ever more of them.
        grid: edge length of a cell [rad, m].
        max_depth, max_excess, max_drift, settle_steps: the checks.

    Raises:
        ConfigError: the goal state itself is refused by the checks that seeds have to pass.
        ValueError: unknown ``seeds``.
    """
    if seeds not in SEEDS:
        raise ValueError(f"seeds={seeds}: must be one of {', '.join(SEEDS)}")

    @jit
    def walk(key: Array, rows: Array) -> StartSet:
        return brownian_walks(
            task,
            key,
            from_rows(task, rows),
            num_walks=num_walks,
            num_snapshots=walk_length,
            walk_length=walk_length,
            noise_std=noise_std,
            noise=noise,
        )

    def sound(rows: np.ndarray) -> np.ndarray:
        qpos = rows[:, : task.model.nq]
        return (limit_excess(task.model, qpos) <= max_excess) & (clearance(task.model, qpos) >= -max_depth)

    def places(rows: np.ndarray) -> np.ndarray:
        return cells(task.grid_coordinates(canonical_quaternions(task.model, rows[:, : task.model.nq])), grid)

    let_go = make_settle(task, settle_steps)
    rng = np.random.default_rng(seed)
    key = jax.random.key(seed)
    goal = to_rows(task.goal_starts())
    if not sound(goal)[0]:
        from rcg_jax.tasks.check_model import overlap

        qpos = goal[:, : task.model.nq]
        excess = float(limit_excess(task.model, qpos)[0])
        beyond = f"a joint is {excess:.4g} beyond its range" if excess > max_excess else ""
        depth = overlap(task.model, qpos[0]) if clearance(task.model, qpos)[0] < -max_depth else ""
        raise ConfigError(
            f"max_depth={max_depth:g} max_excess={max_excess:g}: the goal state does not pass these checks: "
            f"{' and '.join(filter(None, (beyond, depth)))}"
        )
    collected, kept, taken = [goal], [goal[:0]], set[bytes]()
    walks = rejected = 0
    while True:
        pool = kept if seeds == "starts" and any(map(len, kept)) else collected
        drawn = _draw_seeds(rng, pool, num_walks, sound)
        found = walk(jax.random.fold_in(key, walks), jnp.asarray(drawn))
        states = to_rows(found)[np.asarray(found.valid)]
        walks += num_walks
        collected.append(states)
        _, first = np.unique(places(states), axis=0, return_index=True)
        new = states[np.sort(first)]
        names = [row.tobytes() for row in places(new)]
        fresh = np.array([name not in taken for name in names], bool)
        good = fresh.copy()
        good[fresh] = sound(new[fresh])
        stays, drift = let_go(new[good])
        good[good] = stays & (drift <= max_drift)
        rejected += int(fresh.sum() - good.sum())
        taken.update(name for name, ok in zip(names, good, strict=True) if ok)
        kept.append(new[good])
        yield Round(
            rows=np.concatenate(kept),
            visited=sum(map(len, collected)),
            walks=walks,
            rejected=rejected,
            fresh=int(good.sum()),
        )


def _draw_seeds(
    rng: np.random.Generator, collected: list[np.ndarray], num: int, sound: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """``num`` rows drawn uniformly, with replacement, from those of ``collected`` that are sound."""
    ends = np.cumsum([len(states) for states in collected])
    seeds = collected[0][:0]
    while len(seeds) < num:  # ends: the goal state is among the visited states and sound, as all starts are
        which = rng.integers(ends[-1], size=num)
        part = np.searchsorted(ends, which, side="right")
        drawn = np.stack([collected[p][i - ends[p]] for p, i in zip(part, which, strict=True)])
        seeds = np.concatenate([seeds, drawn[sound(drawn)]])
    return seeds[:num]
