"""How the curriculum goes on where the paper is silent: hardly any start good, most mastered, most too hard."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config.settings import CurriculumConfig
from rcg_jax.curriculum.sample_nearby import visit_nearby
from rcg_jax.curriculum.select import Difficulty, Shares
from rcg_jax.sharding.devices import any_of_all_seeds
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartLabels, StartSet, sample_starts


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


def next_seeds(
    config: CurriculumConfig,
    key: Array,
    replay: StartSet,
    *,
    starts: StartSet,
    labels: StartLabels,
    kind: Difficulty,
) -> tuple[StartSet, Array]:
    """Seeds of the next walks, and the mask (C,) of the starts to remember in the replay.

    Where enough starts are good, those are both. The paper is silent about the other cases:

    * few good, most mastered: those of the mastered new starts join them that take longest to the goal. The
      success rate cannot tell mastered starts apart, the time can, and it is longest at the frontier; with all of
      them, the many easy ones close to the goal would hold the curriculum back. Without any, all starts are seeds.
    * few good, most too hard: starts of the replay join as seeds.

    Switches: ``min_good=0`` acts only where none is good, ``outward_share=1`` takes all of the mastered.

    Args:
        config: the curriculum's settings.
        key: PRNG key.
        replay: starts_old.
        starts: rho_i, the new ones first.
        labels: what training showed about them.
        kind: which are too hard, good, mastered.
    """
    is_new = jnp.arange(starts.capacity) < config.num_new
    good, low, high = jnp.sum(kind.good), jnp.sum(kind.low), jnp.sum(kind.high)
    few = good <= config.min_good * (good + low + high)
    advance = few & (high > low)
    mastered = kind.high & is_new
    time = jnp.where(mastered, labels.time_to_goal, -1.0)
    slowest = jnp.ceil(config.outward_share * jnp.sum(mastered))
    rank = jnp.argsort(jnp.argsort(-time, stable=True), stable=True)
    remember = kind.good | (advance & mastered & (rank < slowest))
    mask = jnp.where(advance & ~jnp.any(remember), starts.valid, remember)
    old = sample_starts(key, replay, starts.capacity)
    retreat = few & ~(high > low)
    # Good starts stay in their rows; replayed ones fill the other rows.
    seeds = jax.tree.map(
        lambda a, b: jnp.where((retreat & ~mask).reshape(-1, *(1,) * (a.ndim - 1)), b, a),
        dataclasses.replace(starts, valid=mask),
        old,
    )
    return seeds, remember


def far_seeds(
    config: CurriculumConfig,
    task: Task,
    key: Array,
    *,
    starts: StartSet,
    seeds: StartSet,
    remember: Array,
    shares: Shares,
) -> tuple[StartSet, Array, Array]:
    """Seeds where no start is good and most are mastered, as in the authors' code: states of a few long, strong walks.

    Switch: ``stall_walk``, in horizons T; 0: never. ``stall_walks`` of them keep M states together.

    Returns:
        Seeds and mask as of :func:`next_seeds`, which are ``seeds`` and ``remember`` elsewhere; whether it happened,
        () bool.
    """
    stalled = (shares.share_good == 0) & (shares.share_high > shares.share_low)
    length = config.stall_walk * task.horizon
    kept = min(length, -(-config.num_candidates // config.stall_walks))  # of each walk

    def walked() -> StartSet:
        walk_key, draw_key = jax.random.split(key)
        visited = visit_nearby(
            task,
            walk_key,
            starts,
            num_candidates=config.stall_walks * kept,
            brownian_horizon=kept,
            walk_length=length,
            walk_rounds=1,
            noise_std=config.noise_std * 10**0.5,
            noise=config.noise,
        )
        drawn = sample_starts(draw_key, visited, starts.capacity)
        return dataclasses.replace(drawn, valid=drawn.valid & (jnp.arange(starts.capacity) < config.num_new))

    far = jax.lax.cond(any_of_all_seeds(stalled), walked, lambda: seeds)
    seeds = jax.tree.map(lambda a, b: jnp.where(stalled, a, b), far, seeds)
    return seeds, remember & ~stalled, stalled


def far_steps(config: CurriculumConfig, task: Task) -> int:
    """Physics steps of the walks of :func:`far_seeds`."""
    return config.stall_walks * config.stall_walk * task.horizon
