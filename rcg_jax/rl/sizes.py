"""How many steps, actions and environments a TRPO iteration has, where the settings leave it to the task."""

from __future__ import annotations

import dataclasses

from rcg_jax.config.settings import Config
from rcg_jax.rl.hold import decisions
from rcg_jax.tasks.base import Task

#: Steps of a TRPO iteration unless set: at least these, and this many horizons. The curriculum advances once in
#: ``trpo.iterations`` of them; with larger batches it does so too rarely, and the frontier stands still.
LEAST_STEPS = 20_000
BATCH_HORIZONS = 40

#: Environments of a rollout unless set: at most these.
MOST_ENVS = 400

#: Horizons that an iteration holds in each environment unless set: episodes that begin in its last one give no label.
LEAST_EPISODES = 2

#: Horizons that a batch of whole episodes holds in each environment unless set: at its end environments wait for the
#: last episode, for up to one more.
LEAST_WHOLE_EPISODES = 3


def action_repeat(config: Config, task: Task) -> int:
    """k, physics steps that an action is held for: as set in the configuration, or the task's own."""
    return config.policy.action_repeat or task.action_repeat


def batch_size(config: Config, task: Task) -> int:
    """Physics steps of one TRPO iteration: as set in the configuration, or by the horizon.

    Left open, it is rounded up to whole actions, of ``policy.action_repeat`` steps each, in all environments.
    """
    if config.rollout.batch_size:
        return config.rollout.batch_size
    steps, repeat = max(LEAST_STEPS, BATCH_HORIZONS * task.horizon), action_repeat(config, task)
    if repeat == 1:
        return steps
    row = repeat * (config.rollout.num_envs or _envs_of(steps, config, task))
    return decisions(steps, row) * row


def num_envs(config: Config, task: Task) -> int:
    """N, environments of a rollout: as set in the configuration, or the most that fit."""
    return config.rollout.num_envs or _envs_of(batch_size(config, task), config, task)


def _most_envs(steps: int, config: Config, task: Task) -> int:
    """Environments that so many horizons in each leave: :data:`LEAST_EPISODES`, :data:`LEAST_WHOLE_EPISODES`."""
    repeat = action_repeat(config, task)
    longest = decisions(task.horizon, repeat) * repeat
    if config.rollout.batch == "episodes":
        return max(1, min(MOST_ENVS, steps // (LEAST_WHOLE_EPISODES * longest)))
    return max(1, min(MOST_ENVS, steps * config.trpo.iterations // (LEAST_EPISODES * longest)))


def _envs_of(steps: int, config: Config, task: Task) -> int:
    """The most environments that share so many steps of a TRPO iteration in whole actions.

    Where held actions leave less than half of what there might be and the steps are open, those make room for all.
    """
    repeat, most = action_repeat(config, task), _most_envs(steps, config, task)
    envs = max(n for n in range(1, most + 1) if (steps // repeat) % n == 0)
    few = repeat > 1 and (2 * envs < most or steps % (envs * repeat))
    return most if few and not config.rollout.batch_size else envs


def for_devices(config: Config, task: Task, share: int) -> Config:
    """``config`` with sizes that ``share`` devices can share evenly, where it leaves them open.

    The environments become fewer: 80 instead of 100 on 8 devices. Where no multiple of ``share`` divides the steps of
    a TRPO iteration, or held actions leave few, these become a few more, if they are open, too. ``config`` itself
    where nothing has to change, or nothing helps.
    """
    if config.rollout.num_envs or num_envs(config, task) % share == 0:
        return config
    batch, repeat = batch_size(config, task), action_repeat(config, task)
    multiples = range(share, _most_envs(batch, config, task) + 1, share)
    envs = max((n for n in multiples if batch % (n * repeat) == 0), default=0)
    few = not envs or (repeat > 1 and 2 * envs < multiples[-1])
    if few and multiples and not config.rollout.batch_size:
        envs = multiples[-1]
        batch = decisions(batch, envs * repeat) * envs * repeat
    if not envs:
        return config
    return dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_envs=envs, batch_size=batch))
