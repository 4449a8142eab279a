"""A task's vector environment for Stable-Baselines3 and what has its interface (sb3-contrib, sbx).

from stable_baselines3 import PPO
from rcg_jax.gymnasium import make_vec
from rcg_jax.gymnasium.sb3 import SB3VecEnv

PPO("MlpPolicy", SB3VecEnv(make_vec("ring_peg", 64))).learn(1_000_000)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from rcg_jax.gymnasium.vector_env import TaskVectorEnv


class SB3VecEnv(VecEnv):
    """``TaskVectorEnv`` as SB3's ``VecEnv``: final observations, time limits and success are in ``infos``."""

    def __init__(self, env: TaskVectorEnv) -> None:
        """Wraps ``env``, whose episodes end and begin in the same step, as SB3 expects."""
        self.env = env  # which SB3 asks for its render mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: np.ndarray = np.zeros((env.num_envs, *(env.single_action_space.shape or ())), np.float32)

    def reset(self) -> np.ndarray:
        seeds = [seed for seed in self._seeds if seed is not None]
        names = {name for options in self._options for name in options}
        options = {name: np.stack([each[name] for each in self._options]) for name in names}
        self._reset_seeds()
        self._reset_options()
        return self.env.reset(seed=seeds or None, options=options)[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        obs, reward, terminated, truncated, about = self.env.step(np.asarray(self._actions))
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": about["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(about["success"][i]),
            }
        return obs, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self.env, method_name)(*args, **kwargs)] * len(self._indices(indices))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(self._indices(indices))

    def _indices(self, indices: Any) -> Sequence[int]:
        return list(self._get_indices(indices))
