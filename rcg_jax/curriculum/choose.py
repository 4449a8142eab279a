"""Which of the states that the walks visited become new starts. The paper: any of them, ``selection=random``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from rcg_jax.config.settings import CurriculumConfig
from rcg_jax.curriculum.settle import num_settle_candidates, settled
from rcg_jax.curriculum.spread import nearest_rows, spread_starts
from rcg_jax.rl.agent import Agent
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartSet, concatenate, finite, sample_starts

#: V: (its parameters, normalised observations (C, obs_dim)) -> (C,).
Value = Callable[[Any, Array], Array]


def num_towards_rho_0(config: CurriculumConfig) -> int:
    """How many of the new starts are chosen for being near rho_0 (``curriculum.rho_0_share``)."""
    return round(config.rho_0_share * config.num_new)


def choose_starts(
    config: CurriculumConfig, task: Task, key: Array, visited: StartSet, *, agent: Agent, baseline: Value
) -> StartSet:
    """The N_new starts among those visited.

    The paper draws them uniformly. Then most of them lie where walks linger, and hardly one where the success rate
    falls from 1 to 0, which may be a short stretch: a corner of a maze, the moment when a key comes out of its
    lock. Therefore, with ``selection=spread``, a part is spread evenly over the positions, and a part over the values
    V(s), which fall there. Before both comes the part that is nearest to rho_0, where there is one.

    Args:
        config: the curriculum's settings.
        task: task and physics.
        key: PRNG key.
        visited: the candidates (:func:`rcg_jax.curriculum.sample_nearby.visit_nearby`).
        agent: the agent that is going to be trained on them.
        baseline: V, of ``agent.baseline`` and normalised observations.

    Returns:
        StartSet of capacity N_new. Where fewer settle there are repetitions, where none does invalid rows.
    """
    parts = []
    towards = num_towards_rho_0(config)
    if towards:
        rho_key, key = jax.random.split(key)
        parts.append(towards_rho_0(task, rho_key, visited, agent, towards))
    rest = config.num_new - towards
    if rest and config.selection == "random":
        drawn = sample_starts(key, visited, num_settle_candidates(task, rest))
        parts.append(settled(task, drawn, rest))
    elif rest:
        value_key, position_key = jax.random.split(key)
        by_value = round(config.value_share * rest)
        if by_value:
            value = baseline(agent.baseline, _seen(task, visited, agent))
            parts.append(_spread(task, value_key, visited, value[:, None], by_value))
        if rest > by_value:
            positions = task.grid_coordinates(visited.qpos)
            parts.append(_spread(task, position_key, visited, positions, rest - by_value))
    return concatenate(*parts)


def towards_rho_0(task: Task, key: Array, visited: StartSet, agent: Agent, num: int) -> StartSet:
    """Of those visited the nearest to each of ``num`` draws of rho_0, as the policy sees both.

    What walks visit most is what is easy to visit. Most of rho_0 is further than they have got, and its draws there
    take states at the edge of what is visited; and they take the poses that rho_0 has, however seldom a walk meets
    them. Near is a straight line through the observations: behind a wall it need not be the edge that one gets on
    from, as just before a corner of a maze; the starts that are spread find that.
    """
    targets = task.sample_feasible(key, num_settle_candidates(task, num))
    rows = nearest_rows(_seen(task, visited, agent), visited.valid, _seen(task, targets, agent))
    return settled(task, visited.take(rows), num)


def _spread(task: Task, key: Array, visited: StartSet, points: Array, num: int) -> StartSet:
    """``num`` of those visited, spread over the coordinates ``points`` (C, d)."""
    return settled(task, spread_starts(key, visited, points, num_settle_candidates(task, num)), num)


def _seen(task: Task, starts: StartSet, agent: Agent) -> Array:
    """Normalised observations of starts at rest, (C, obs_dim)."""
    return agent.norm(finite(task.observe_batch(task.reset(starts)))[0])
