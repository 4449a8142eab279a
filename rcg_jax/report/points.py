"""Where a task's states lie in pictures: the point that has to come to the goal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rcg_jax.physics.jit import jit
from rcg_jax.tasks.base import Task
from rcg_jax.types import Snapshot, StartSet

#: Rows of one call of the compiled function: all calls have the same shape.
_CHUNK = 2048

#: States that show which point of the model the task is about.
_SAMPLE = 500


@dataclass(frozen=True)
class Places:
    """Where K states lie.

    Attributes:
        point: (K, 3) the task's point in the world [m].
        distance: (K,) to the goal [m].
        regions: (K,) bool for each subset of the task's composition, by name.
    """

    point: np.ndarray
    distance: np.ndarray
    regions: dict[str, np.ndarray]


class Locator:
    """Finds the places of states of one task.

    Attributes:
        name: what the point is, in words: the task's ``point_name``, or what it is called in the model; empty where
            the task computes it and gives it no name.
        goal: (3,) where the point has to be: the model's site ``goal``, or where it is in the goal state [m].
    """

    def __init__(self, task: Task, feasible: np.ndarray) -> None:
        """Finds out which point the task is about.

        Args:
            task: the task.
            feasible: (K, nq) some feasible starts; may be none.
        """
        self._task = task
        found, self._point, goal = _choose(task, feasible)
        self.name = task.point_name or (f"the model's “{found}”" if found else "")
        self._look: Callable[..., Any] = jit(self._look_at)
        self.goal = self(np.asarray(task.goal_state, np.float32)[None]).point[0] if goal is None else goal

    def _look_at(self, qpos: Array) -> tuple[Array, Array, dict[str, Array]]:
        task = self._task
        s = task.snapshot(task.reset(StartSet.at_rest(qpos, task.model.nv)))
        return jax.vmap(self._point)(s), jax.vmap(task.distance)(s), jax.vmap(task.composition)(s)

    def __call__(self, qpos: np.ndarray) -> Places:
        """The places of states (K, nq), at rest."""
        # A state without finite positions gets the goal state's kinematics and no place.
        fine = np.isfinite(qpos).all(axis=1)
        qpos = np.where(fine[:, None], qpos, np.asarray(self._task.goal_state, np.float32))
        parts = []
        for begin in range(0, max(len(qpos), 1), _CHUNK):
            chunk = qpos[begin : begin + _CHUNK]
            padded = np.zeros((_CHUNK, self._task.model.nq), np.float32)
            padded[: len(chunk)] = chunk
            padded[len(chunk) :] = self._task.goal_state
            parts.append(jax.device_get(self._look(jnp.asarray(padded))))
        point, distance, regions = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(qpos)], *parts)
        return Places(np.where(fine[:, None], point, np.nan), distance, regions)


def _choose(task: Task, feasible: np.ndarray) -> tuple[str, Callable[[Snapshot], Array], np.ndarray | None]:
    """The task's point: its name in the model, if it is in there, a function of a state, and its goal, if that is."""
    goal_state = np.asarray(task.goal_state, np.float32)[None]
    rows = np.unique(np.linspace(0, len(feasible) - 1, min(_SAMPLE, len(feasible))).astype(int))
    sample = np.concatenate([goal_state, feasible[rows].astype(np.float32)])

    def look(qpos: Array) -> tuple[Snapshot, Array, Array | None]:
        s = task.snapshot(task.reset(StartSet.at_rest(qpos, task.model.nv)))
        return s, jax.vmap(task.distance)(s), jax.vmap(task.point)(s)

    snapshot, distance, own = jax.device_get(jit(look)(jnp.asarray(sample)))
    if own is not None:
        return "", lambda s: jnp.asarray(task.point(s)), None
    model = task.model
    candidates = [(model.site(i).name, "site_xpos", i) for i in range(model.nsite)]
    candidates += [(model.body(i).name, "xpos", i) for i in range(1, model.nbody)]
    places = [np.asarray(getattr(snapshot, leaf))[:, i] for _, leaf, i in candidates]
    goals = [place[0] for (name, leaf, _), place in zip(candidates, places) if (name, leaf) == ("goal", "site_xpos")]
    for goal in goals:
        for (name, leaf, index), place in zip(candidates, places):
            if np.allclose(np.linalg.norm(place - goal, axis=1), distance, atol=1e-4):
                return name, _taking(leaf, index), goal
    best = max(range(len(candidates)), key=lambda k: _fit(places[k], distance))
    name, leaf, index = candidates[best]
    return name, _taking(leaf, index), None


def _taking(leaf: str, index: int) -> Callable[[Snapshot], Array]:
    return lambda s: getattr(s, leaf)[index]  # type: ignore[no-any-return]


def _fit(place: np.ndarray, distance: np.ndarray) -> float:
    """Correlation of a point's way from its place (K, 3) in row 0, the goal state, with the task's distance (K,)."""
    way = np.linalg.norm(place - place[0], axis=1)
    if way.std() < 1e-9 or np.std(distance) < 1e-9:
        return -1.0
    return float(np.corrcoef(way, distance)[0, 1])
