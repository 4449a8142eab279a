"""How the curriculum goes on where the paper is silent: hardly any start good, most mastered, most too hard."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config.settings import CurriculumConfig
from rcg_jax.curriculum.sample_nearby import visit_nearby
from rcg_jax.curriculum.select import Difficulty, Shares
from rcg_jax.sharding.devices import any_of_all_seeds
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet, sample_starts, where_rows


def next_walk_length(config: CurriculumConfig, length: Array, shares: Shares, *, can_fail: bool) -> Array:
    """T_B of the next walks, (): longer while most starts are mastered, shorter while most are too hard.

    Where an episode can fail (``can_fail``), chance failures keep even easy starts from being mastered, and walks would
    stay short for ever. There T_B grows while hardly any start is too hard, too. Switch: ``brownian_horizon_max`` equal
    to ``brownian_horizon`` keeps T_B fixed, as in the paper.
    """
    easy = shares.share_high > config.grow_above
    if can_fail:
        easy |= (shares.labelled > 0) & (shares.share_low < config.grow_below)
    factor = config.growth
    change = jnp.where(easy, factor, jnp.where(shares.share_low > config.shrink_above, 1 / factor, 1.0))
    return jnp.clip(length * change, config.brownian_horizon, config.brownian_horizon_max)


class NextSeeds(NamedTuple):
    """What follows from select.

    Attributes:
        seeds: where the next walks begin, capacity C.
        remember: (C,) bool, the starts of rho_i that enter the replay.
        steps: () physics steps that finding seeds took.
    """

    seeds: StartSet
    remember: Array
    steps: Array


def next_seeds(
    config: CurriculumConfig,
    task: Task,
    keys: tuple[Array, Array],
    replay: StartSet,
    *,
    starts: StartSet,
    labels: StartLabels,
    kind: Difficulty,
) -> NextSeeds:
    """Seeds of the next walks, and the starts to remember in the replay.

    Where enough starts are good, those are both. The paper is silent about the other cases:

    * few good, most mastered (advance): those of the mastered new starts join them that take longest to the goal. The
      success rate cannot tell mastered starts apart, the time can, and it is longest at the frontier; with all of
      them, the many easy ones close to the goal would hold the curriculum back. Without any, all starts are seeds.
    * few good, most too hard (retreat): starts of the replay join as seeds.
    * none good, most mastered, and ``stall_walk`` set, as in the authors' code: states of a few long, strong walks.

    Switches: ``min_good=0`` acts only where none is good, ``outward_share=1`` takes all of the mastered,
    ``stall_walk=0`` has no such walks.

    Args:
        config: the curriculum's settings.
        task: task and physics.
        keys: PRNG keys of the draw from the replay, and of the walks.
        replay: starts_old.
        starts: rho_i, the new ones first.
        labels: what training showed about them.
        kind: which are too hard, good, mastered.
    """
    draw_key, walk_key = keys
    good, low, high = jnp.sum(kind.good), jnp.sum(kind.low), jnp.sum(kind.high)
    few = good <= config.min_good * (good + low + high)
    advance, retreat = few & (high > low), few & ~(high > low)
    mastered = kind.high & (jnp.arange(starts.capacity) < config.num_new)
    remember = kind.good | (advance & _longest(mastered, labels.time_to_goal, config.outward_share))
    mask = jnp.where(advance & ~jnp.any(remember), starts.valid, remember)
    # Good starts stay in their rows; replayed ones fill the other rows.
    old = sample_starts(draw_key, replay, starts.capacity)
    seeds = where_rows(retreat & ~mask, old, dataclasses.replace(starts, valid=mask))
    if not config.stall_walk:
        return NextSeeds(seeds, remember, jnp.float32(0))
    stalled = advance & (good == 0)
    length = config.stall_walk * task.horizon
    walked = jax.lax.cond(
        any_of_all_seeds(stalled), lambda: stall_seeds(config, task, walk_key, starts, length), lambda: seeds
    )
    seeds = jax.tree.map(lambda a, b: jnp.where(stalled, a, b), walked, seeds)
    steps = jnp.float32(stalled * config.stall_walks * length)
    return NextSeeds(seeds, remember & ~stalled, steps)


def _longest(mask: Array, time: Array, share: float) -> Array:
    """The ``share`` of the rows in ``mask`` with the longest ``time``, rounded up, (C,) bool."""
    time = jnp.where(mask, time, -1.0)
    rank = jnp.argsort(jnp.argsort(-time, stable=True), stable=True)
    return mask & (rank < jnp.ceil(share * jnp.sum(mask)))


def stall_seeds(config: CurriculumConfig, task: Task, key: Array, starts: StartSet, length: int) -> StartSet:
    """States of ``stall_walks`` walks of ``length`` steps from ``starts``, with ten times the variance.

    The walks keep M states together; N_new of them are valid seeds.
    """
    walk_key, draw_key = jax.random.split(key)
    kept = min(length, -(-config.num_candidates // config.stall_walks))  # of each walk
    visited = visit_nearby(
        task,
        walk_key,
        starts,
        num_candidates=config.stall_walks * kept,
        num_snapshots=kept,
        walk_length=length,
        walk_rounds=1,
        noise_std=config.noise_std * 10**0.5,
        noise=config.noise,
    )
    drawn = sample_starts(draw_key, visited, starts.capacity)
    return dataclasses.replace(drawn, valid=drawn.valid & (jnp.arange(starts.capacity) < config.num_new))
