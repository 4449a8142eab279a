"""A task as one Gymnasium environment, for tools that want one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rcg_jax.gymnasium.vector_env import TaskVectorEnv, make_vec
from rcg_jax.tasks import Task


class TaskEnv(gymnasium.Env):
    """One environment with Gymnasium's plain interface: :class:`TaskVectorEnv` with one environment, without autoreset.

    ``reset`` takes ``options`` with ``qpos`` (nq,), ``qvel`` (nv,) and ``act`` (na,). ``infos`` has ``success``,
    ``steps`` and ``start``.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's contract

    def __init__(self, env: TaskVectorEnv) -> None:
        """See :func:`make`."""
        self._env = env
        self.task = env.task
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        batched = {name: np.asarray(value)[None] for name, value in (options or {}).items()}
        obs, infos = self._env.reset(seed=seed, options=batched)
        self._over = False
        return obs[0], {"start": int(infos["start"][0])}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or never began: call reset()")
        obs, reward, terminated, truncated, infos = self._env.step(np.asarray(action)[None])
        self._over = over = bool(terminated[0] or truncated[0])
        about = {"success": bool(infos["success"][0]), "steps": int(infos["steps"][0]), "start": int(infos["start"][0])}
        last = infos["final_obs"] if over else obs
        return last[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), about


def make(task: str | Task, **settings: Any) -> TaskEnv:
    """A :class:`TaskEnv`; settings and errors as of :func:`make_vec`."""
    return TaskEnv(make_vec(task, 1, **settings))
