"""Where a task's states lie in pictures: the point that has to come to the goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.io.manifest import brief
from rcg_jax.io.starts_file import StartsFileError
from rcg_jax.physics.jit import jit
from rcg_jax.tasks.base import Task

#: Rows of one call of the compiled function: all calls have the same shape.
_CHUNK = 2048

#: States that show which point of the model the task is about.
_SAMPLE = 500


def evenly(number: int, most: int) -> np.ndarray:
    """At most ``most`` of ``number`` rows, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, number - 1, min(most, number)).astype(int))


def feasible_states(task: Task) -> tuple[np.ndarray, str]:
    """Positions (K, nq) of a task's feasible starts; if there are none, why."""
    try:
        return np.asarray(task.feasible_starts().qpos), ""
    except (FileNotFoundError, StartsFileError) as error:
        return np.zeros((0, task.model.nq), np.float32), brief(error)


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

    def __init__(self, task: Task, states: np.ndarray) -> None:
        """Finds out which point ``task`` is about, from some of its states (K, nq); there may be none."""
        self._goal_state = np.asarray(task.goal_state, np.float32)

        def look(qpos: Array) -> Any:
            s = task.snapshot(task.reset(task.at_rest(qpos)))
            points = jnp.concatenate([s.site_xpos, s.xpos[:, 1:]], axis=1)
            return points, *(jax.vmap(f)(s) for f in (task.point, task.distance, task.composition))

        self._look = jit(look)
        states = states[np.isfinite(states).all(axis=1)]
        sample = states[evenly(len(states), _SAMPLE)]
        points, own, distance, _ = self._look_at(np.concatenate([self._goal_state[None], sample]))
        if own is None:
            found, self._index, self.goal = _choose(task.model, points, distance)
        else:
            found, self._index, self.goal = "", 0, own[0]
        self.name = task.point_name or (f"the model's “{found}”" if found else "")

    def _look_at(self, qpos: np.ndarray) -> Any:
        """Of states (K, nq): the model's points (K, P, 3), the task's own (K, 3) or None, distances and regions."""
        chunks = max(1, -(-len(qpos) // _CHUNK))
        padded = np.tile(self._goal_state, (chunks * _CHUNK, 1))
        padded[: len(qpos)] = qpos
        parts = [jax.device_get(self._look(jnp.asarray(chunk))) for chunk in np.split(padded, chunks)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(qpos)], *parts)

    def __call__(self, qpos: np.ndarray) -> Places:
        """The places of states (K, nq), at rest."""
        # A state without finite positions gets the goal state's kinematics and no place.
        fine = np.isfinite(qpos).all(axis=1, keepdims=True)
        points, own, distance, regions = self._look_at(np.where(fine, qpos, self._goal_state))
        point = points[:, self._index] if own is None else own
        return Places(np.where(fine, point, np.nan), distance, regions)


def _choose(model: mujoco.MjModel, points: np.ndarray, distance: np.ndarray) -> tuple[str, int, np.ndarray]:
    """The site or body that the task is about: its name, its index, its goal (3,).

    Args:
        model: the task's model.
        points: (K, P, 3) all sites, and all bodies but the world, in K states; the first is the goal state.
        distance: (K,) the task's distance to the goal.
    """
    sites = [model.site(i).name for i in range(model.nsite)]
    names = sites + [model.body(i).name for i in range(1, model.nbody)]
    if "goal" in sites:
        goal = points[:, sites.index("goal")]
        exact = np.isclose(np.linalg.norm(points - goal[:, None], axis=2), distance[:, None], atol=1e-4).all(axis=0)
        if exact.any():
            found = int(np.argmax(exact))
            return names[found], found, goal[0]
    # The task measures something else: the point whose distance from its own goal goes most with that.
    away = np.linalg.norm(points - points[0], axis=2).T
    fits = [np.corrcoef(one, distance)[0, 1] if min(one.std(), distance.std()) > 1e-9 else -1 for one in away]
    found = int(np.argmax(fits))
    return names[found], found, points[0, found]
