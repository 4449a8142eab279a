"""How many environments a rollout has and how many steps a TRPO iteration, where the settings leave it open."""

from __future__ import annotations

import dataclasses

from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.rl.hold import decisions

#: Steps of a TRPO iteration: at least these, and this many horizons. The curriculum advances once in
#: ``trpo.iterations`` of them; with larger batches it does so too rarely, and the frontier stands still.
MIN_BATCH_STEPS, BATCH_HORIZONS = 20_000, 40

#: Environments of a rollout: at most these.
MAX_ENVS = 400

#: Horizons that one environment needs: of segments in a curriculum iteration, where episodes that begin in the last one
#: give no label; of whole episodes in a batch, at whose end environments wait for the last episode, for up to one more.
SEGMENT_HORIZONS, EPISODE_HORIZONS = 2, 3


def with_sizes(config: Config, horizon: int, share: int = 1) -> Config:
    """``config`` with ``rollout.num_envs`` and ``rollout.batch_size``, where they are left open (0).

    They depend on the horizon, on held actions, and on how many devices share the environments.

    Args:
        config: the settings.
        horizon: T of its task [physics steps].
        share: devices that the environments are spread over evenly, if possible.

    Raises:
        ConfigError: the environments do not divide a TRPO iteration's steps, or the TRPO iterations of one curriculum
            iteration, of segments, are too short for one whole episode.
    """
    envs, batch = config.rollout.num_envs, config.rollout.batch_size
    repeat = config.policy.action_repeat
    if not batch:
        batch = max(MIN_BATCH_STEPS, BATCH_HORIZONS * horizon)
        if repeat > 1:  # whole actions in all environments
            row = repeat * (envs or _num_envs(config, horizon, batch))
            batch = decisions(batch, row) * row
    if not envs:
        envs, batch = _shared(config, horizon, _num_envs(config, horizon, batch), batch, share)
    _check(config, horizon, envs, batch)
    return dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_envs=envs, batch_size=batch))


def _max_envs(config: Config, horizon: int, steps: int) -> int:
    """The most environments that so many steps of a TRPO iteration give their horizons."""
    repeat = config.policy.action_repeat
    longest = decisions(horizon, repeat) * repeat
    if config.rollout.batch == "episodes":
        return max(1, min(MAX_ENVS, steps // (EPISODE_HORIZONS * longest)))
    return max(1, min(MAX_ENVS, steps * config.trpo.iterations // (SEGMENT_HORIZONS * longest)))


def _num_envs(config: Config, horizon: int, steps: int) -> int:
    """The most environments that share so many steps of a TRPO iteration in whole actions.

    Where held actions leave less than half of what there might be and the steps are open, those make room for all.
    """
    repeat, most = config.policy.action_repeat, _max_envs(config, horizon, steps)
    envs = max(n for n in range(1, most + 1) if (steps // repeat) % n == 0)
    few = repeat > 1 and (2 * envs < most or steps % (envs * repeat))
    return most if few and not config.rollout.batch_size else envs


def _shared(config: Config, horizon: int, envs: int, batch: int, share: int) -> tuple[int, int]:
    """Environments and steps that ``share`` devices can share evenly; as they are where nothing helps.

    The environments become fewer: 80 instead of 100 on 8 devices. Where no multiple of ``share`` divides the steps of
    a TRPO iteration, or held actions leave few, these become a few more, if they are open.
    """
    if envs % share == 0:
        return envs, batch
    repeat = config.policy.action_repeat
    multiples = range(share, _max_envs(config, horizon, batch) + 1, share)
    fewer = max((n for n in multiples if batch % (n * repeat) == 0), default=0)
    few = not fewer or (repeat > 1 and 2 * fewer < multiples[-1])
    if few and multiples and not config.rollout.batch_size:
        fewer = multiples[-1]
        batch = decisions(batch, fewer * repeat) * fewer * repeat
    return fewer or envs, batch


def _check(config: Config, horizon: int, envs: int, batch: int) -> None:
    repeat, inner = config.policy.action_repeat, config.trpo.iterations
    if repeat > horizon:
        raise ConfigError(f"policy.action_repeat={repeat}: must be <= {horizon}, the steps of an episode")
    if batch % repeat:
        raise ConfigError(f"rollout.batch_size={batch}: must be a multiple of policy.action_repeat={repeat}")
    if batch % (envs * repeat):
        raise ConfigError(
            f"rollout.num_envs={envs}: times policy.action_repeat={repeat} must divide the steps of a TRPO iteration, "
            f"{batch} for horizon {horizon}"
        )
    longest = decisions(horizon, repeat) * repeat
    if config.rollout.batch == "episodes" and batch < envs * longest:
        raise ConfigError(
            f"rollout.num_envs={envs}: must be <= {max(1, batch // longest)}, so that rollout.batch_size={batch} steps "
            f"hold one episode of {longest} steps in each; more of them would make the batch larger"
        )
    total = batch // envs * inner
    if total < longest and config.rollout.batch == "segments":
        raise ConfigError(
            f"rollout.num_envs={envs}: must be <= {batch * inner // longest}, so that "
            f"trpo.iterations * rollout.batch_size / rollout.num_envs = {total} steps hold one episode of "
            f"{longest} steps"
        )
