"""How many steps, actions and environments a TRPO iteration has, where the settings leave it to the task."""

from __future__ import annotations

import dataclasses

from rcg_jax.config import Config
from rcg_jax.rl.hold import decisions
from rcg_jax.tasks.task import Task

#: Steps of a TRPO iteration unless set: at least these, and this many horizons. The curriculum advances once in
#: ``trpo.iterations`` of them; with larger batches it does so too rarely, and the frontier stands still.
LEAST_STEPS = 20_000
BATCH_HORIZONS = 40

#: Environments of a rollout unless set: at most these.
MOST_ENVS = 400

#: Horizons that an iteration holds in each environment unless set: episodes that begin in its last one give no label.
LEAST_EPISODES = 2


def action_repeat(config: Config, task: Task) -> int:
    """k, physics steps that an action is held for: as set (:class:`rcg_jax.config.PolicyConfig`), or the task's own."""
    return config.policy.action_repeat or task.action_repeat


def batch_size(config: Config, task: Task) -> int:
    """Physics steps of one TRPO iteration: as set (:class:`rcg_jax.config.RolloutConfig`), or by the horizon.

    Left open, it is rounded up to whole actions, of ``policy.action_repeat`` steps each.
    """
    repeat = action_repeat(config, task)
    return config.rollout.batch_size or decisions(max(LEAST_STEPS, BATCH_HORIZONS * task.horizon), repeat) * repeat


def _most_envs(config: Config, task: Task) -> int:
    """Environments that an iteration can have so that it holds :data:`LEAST_EPISODES` horizons in each."""
    steps = batch_size(config, task) * config.trpo.iterations
    repeat = action_repeat(config, task)
    longest = decisions(task.horizon, repeat) * repeat
    return max(1, min(MOST_ENVS, steps // (LEAST_EPISODES * longest)))


def num_envs(config: Config, task: Task) -> int:
    """N, environments of a rollout: as set (:class:`rcg_jax.config.RolloutConfig`), or the most that fit."""
    if config.rollout.num_envs:
        return config.rollout.num_envs
    actions = batch_size(config, task) // action_repeat(config, task)
    return max(n for n in range(1, _most_envs(config, task) + 1) if actions % n == 0)


def for_devices(config: Config, task: Task, share: int) -> Config:
    """``config`` with sizes that ``share`` devices can share evenly, where it leaves them open.

    The environments become fewer: 80 instead of 100 on 8 devices. Where no multiple of ``share`` divides the steps of
    a TRPO iteration, these become a few more, if they are open, too. ``config`` itself where nothing has to
    change, or nothing helps.
    """
    if config.rollout.num_envs or num_envs(config, task) % share == 0:
        return config
    batch, repeat = batch_size(config, task), action_repeat(config, task)
    multiples = range(share, _most_envs(config, task) + 1, share)
    envs = max((n for n in multiples if batch % (n * repeat) == 0), default=0)
    if not envs and multiples and not config.rollout.batch_size:
        envs = multiples[-1]
        batch = decisions(batch, envs * repeat) * envs * repeat
    if not envs:
        return config
    return dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_envs=envs, batch_size=batch))
