"""How many steps and environments a TRPO iteration has, where the settings leave it to the task's horizon."""

from __future__ import annotations

from rcg_jax.config import Config
from rcg_jax.tasks.task import Task

#: Steps of a TRPO iteration unless set: at least these, and this many horizons. The curriculum advances once in
#: ``trpo.iterations`` of them; with larger batches it does so too rarely, and the frontier stands still.
LEAST_STEPS = 20_000
BATCH_HORIZONS = 40

#: Environments of a rollout unless set: at most these.
MOST_ENVS = 400

#: Horizons that an iteration holds in each environment unless set: episodes that begin in its last one give no label.
LEAST_EPISODES = 2


def batch_size(config: Config, task: Task) -> int:
    """Steps of one TRPO iteration: as set (:class:`rcg_jax.config.RolloutConfig`), or by the horizon."""
    return config.rollout.batch_size or max(LEAST_STEPS, BATCH_HORIZONS * task.horizon)


def num_envs(config: Config, task: Task) -> int:
    """N, environments of a rollout: as set (:class:`rcg_jax.config.RolloutConfig`), or the most that fit."""
    if config.rollout.num_envs:
        return config.rollout.num_envs
    batch = batch_size(config, task)
    most = max(1, min(MOST_ENVS, batch * config.trpo.iterations // (LEAST_EPISODES * task.horizon)))
    return max(n for n in range(1, most + 1) if batch % n == 0)
