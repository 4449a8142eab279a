"""Rivals with the interface of Stable-Baselines3: SAC and TQC with HER, PPO, TRPO, CrossQ; from rho_0.

.venv-race/bin/python -m experiments.race.sb3 trainer=sac_her task=ring_peg minutes=30 folder=runs/race/x
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from experiments.common import options
from experiments.race.snapshots import Predict, elapsed, name
from rcg_jax import ReverseCurriculum
from rcg_jax.config.settings import option
from rcg_jax.gymnasium import make_vec
from rcg_jax.gymnasium.sb3 import SB3VecEnv
from rcg_jax.tasks import Task

#: What the name of a trainer with our curriculum ends in.
_RCG = "_rcg"

_TRAINERS = ("sac_her", "tqc_her", "ppo", "trpo", "crossq", f"ppo{_RCG}", f"sac_her{_RCG}")


@dataclass(frozen=True)
class RivalOptions:
    """Settings of ``python -m experiments.race.sb3``."""

    trainer: str = option("sac_her", "algorithm; those that end in _rcg have our curriculum", choices=_TRAINERS)
    task: str = option("ring_peg", "task")
    seed: int = option(0, "seed", low=0)
    minutes: float = option(30.0, "time limit", low=0.01)
    env_steps: int = option(0, "limit of physics steps; 0: none", low=0)
    folder: str = option("runs/race/rival", "where snapshots go")
    every: float = option(60.0, "seconds between snapshots", low=1.0)
    settings: str = option("", "a Python dictionary of settings that replace those of the table")


#: Where observations hold what a goal is about, and where that has to be: HER gives it other values afterwards.
GOALS: Mapping[str, tuple[slice, Callable[[Task], np.ndarray]]] = {
    "ring_peg": (slice(14, 17), lambda task: task.model.site("goal").pos),
    "key_insertion": (
        slice(14, 23),
        lambda task: np.concatenate([task.model.site(s).pos for s in ("goal", "goal_top", "goal_side")]),
    ),
    "point_maze": (slice(0, 2), lambda task: np.asarray(task.goal)),  # type: ignore[attr-defined]
}

#: Replay with HER: "future" goals, four for one, as in the paper of HER and in RL Zoo's settings for Fetch and Panda.
_HER: Mapping[str, Any] = {
    "policy": "MultiInputPolicy",
    "replay_buffer_class": HerReplayBuffer,
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "buffer_size": 1_000_000,
    "batch_size": 256,
    "learning_rate": 1e-3,
    "gamma": 0.98,
    "tau": 0.05,
    "learning_starts": 10_000,
    "policy_kwargs": {"net_arch": [256, 256]},
}

#: Environments, and settings of the algorithm. What was tried for them is in docs/race.md.
SETTINGS: Mapping[str, tuple[int, Mapping[str, Any]]] = {
    "sac_her": (16, {**_HER, "train_freq": 1, "gradient_steps": 8}),
    "tqc_her": (
        16,
        {**_HER, "train_freq": 1, "gradient_steps": 8, "policy_kwargs": {"net_arch": [256, 256], "n_critics": 2}},
    ),
    "ppo": (
        64,
        {
            "policy": "MlpPolicy",
            "n_steps": 256,
            "batch_size": 1024,
            "n_epochs": 10,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "learning_rate": 3e-4,
            "policy_kwargs": {"log_std_init": -0.5},
        },
    ),
    "trpo": (
        64,
        {
            "policy": "MlpPolicy",
            "n_steps": 256,
            "batch_size": 1024,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "cg_max_steps": 10,
            "n_critic_updates": 20,
        },
    ),
    "crossq": (
        16,
        {"policy": "MlpPolicy", "train_freq": 1, "gradient_steps": 4, "gamma": 0.98, "learning_starts": 10_000},
    ),
}


def algorithm(trainer: str) -> Any:
    """The class of a rival; ``trainer`` without ``_rcg``."""
    if trainer in ("tqc_her", "trpo"):
        import sb3_contrib

        return sb3_contrib.TQC if trainer == "tqc_her" else sb3_contrib.TRPO
    if trainer == "crossq":
        import sbx

        return sbx.CrossQ
    return {"sac_her": SAC, "ppo": PPO}[trainer]


class GoalEnv(VecEnvWrapper):
    """Observations with achieved and desired goal, and the reward of Gymnasium-Robotics: -1 until the goal, then 0."""

    def __init__(self, venv: SB3VecEnv, task: Task) -> None:
        """Wraps ``venv``."""
        self.part, goal = GOALS[task.name][0], GOALS[task.name][1](task)
        self.goal = np.asarray(goal, np.float32)
        self.radius = float(task.goal_radius)  # type: ignore[attr-defined]
        box = venv.observation_space
        goal_box = gymnasium.spaces.Box(-np.inf, np.inf, self.goal.shape, np.float32)
        spaces = {"observation": box, "achieved_goal": goal_box, "desired_goal": goal_box}
        super().__init__(venv, gymnasium.spaces.Dict(spaces))

    def _dict(self, obs: np.ndarray) -> dict[str, np.ndarray]:
        goal = np.broadcast_to(self.goal, (*obs.shape[:-1], *self.goal.shape)).copy()
        return {"observation": obs, "achieved_goal": obs[..., self.part].copy(), "desired_goal": goal}

    def reset(self) -> Any:
        return self._dict(np.asarray(self.venv.reset()))

    def step_wait(self) -> Any:
        obs, reward, done, infos = self.venv.step_wait()
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = self._dict(infos[i]["terminal_observation"])
        return self._dict(np.asarray(obs)), reward - 1.0, done, infos

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        """-1 outside the goal set, 0 inside."""
        return -(np.linalg.norm(achieved - desired, axis=-1) >= self.radius).astype(np.float32)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        if method_name == "compute_reward":
            return [self.compute_reward(*args, **kwargs)]
        return self.venv.env_method(method_name, *args, indices=indices, **kwargs)


class _Snapshots(BaseCallback):
    """Saves the policy every so many seconds, and ends the training at its limits."""

    def __init__(self, chosen: RivalOptions, repeat: int) -> None:
        super().__init__()
        self.chosen, self.repeat, self.saved = chosen, repeat, 0.0
        self.folder = Path(chosen.folder) / "snapshots"
        self.folder.mkdir(parents=True)

    def _on_step(self) -> bool:
        now = elapsed()
        steps = self.num_timesteps * self.repeat
        last = now >= 60 * self.chosen.minutes or 0 < self.chosen.env_steps <= steps
        if last or now - self.saved >= self.chosen.every:
            self.saved = now
            save(self.model, self.folder / name(now, steps))
            rate = [episode.get("is_success", 0) for episode in self.model.ep_info_buffer or []]
            shown = f"success of recent episodes {np.mean(rate):.3f}" if rate else ""
            print(f"{now:7.0f} s  {steps:>11,} env steps  {shown}", flush=True)
        return not last


def save(model: Any, path: Path) -> None:
    """The policy, and the statistics that its observations are normalised with."""
    scale = {}
    venv = model.get_vec_normalize_env()
    if venv is not None:
        scale = {"mean": venv.obs_rms.mean, "std": np.sqrt(venv.obs_rms.var + venv.epsilon), "clip": venv.clip_obs}
    path.mkdir()
    if not type(model).__module__.startswith("sbx"):  # whose policies cannot be read alone
        model.policy.save(path / "policy.pt")
    else:
        model.save(path / "model.zip")
    np.savez(path / "scale.npz", **scale)


def load(path: Path, trainer: str, task: str) -> Predict:
    """A snapshot as a function of observations."""
    trainer = trainer.removesuffix(_RCG)
    if (path / "policy.pt").exists():
        policy_class = algorithm(trainer).policy_aliases[SETTINGS[trainer][1]["policy"]]
        model: Any = policy_class.load(path / "policy.pt", device="cpu")
        model.set_training_mode(False)
    else:
        model = algorithm(trainer).load(path / "model.zip")
    scale = dict(np.load(path / "scale.npz"))
    goal_env = GoalEnv(SB3VecEnv(make_vec(task, 1)), make_vec(task, 1).task) if trainer.endswith("her") else None

    def predict(obs: np.ndarray, mean: bool) -> np.ndarray:
        if scale:
            obs = np.clip((obs - scale["mean"]) / scale["std"], -scale["clip"], scale["clip"]).astype(np.float32)
        seen = goal_env._dict(obs) if goal_env else obs
        return np.clip(np.asarray(model.predict(seen, deterministic=mean)[0]), -1.0, 1.0)

    return predict


def _value(model: Any, venv: VecNormalize, obs: np.ndarray) -> np.ndarray:
    """V of raw observations (n, obs_dim)."""
    with torch.no_grad():
        return model.policy.predict_values(torch.as_tensor(venv.normalize_obs(obs))).squeeze(1).numpy()


def main() -> int:
    """Trains until the time limit."""
    chosen = options(RivalOptions, "experiments.race.sb3")
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    trainer = chosen.trainer.removesuffix(_RCG)
    num_envs, settings = SETTINGS[trainer]
    settings = {**settings, **(eval(chosen.settings) if chosen.settings else {})}
    num_envs = settings.pop("num_envs", num_envs)
    values: list[Callable[[np.ndarray], np.ndarray]] = []  # of the model, which needs the environment first

    def value(obs: np.ndarray) -> np.ndarray:
        return values[-1](obs) if values else np.zeros(len(obs))

    curriculum = None
    if trainer != chosen.trainer:
        curriculum = ReverseCurriculum(chosen.task, seed=chosen.seed, value=value if trainer == "ppo" else None)
    env = make_vec(curriculum.task if curriculum else chosen.task, num_envs, curriculum=curriculum)
    venv: VecEnv = SB3VecEnv(env)
    if trainer.endswith("her"):
        venv = VecMonitor(GoalEnv(venv, env.task), info_keywords=("is_success",))
    else:
        venv = VecNormalize(VecMonitor(venv, info_keywords=("is_success",)), norm_reward=False)
    if "replay_buffer_kwargs" in settings:
        settings = {**settings, "replay_buffer_kwargs": dict(settings["replay_buffer_kwargs"])}
    model = algorithm(trainer)(env=venv, seed=chosen.seed, device="cpu", verbose=0, **settings)
    if isinstance(venv, VecNormalize):
        values.append(functools.partial(_value, model, venv))
    model.learn(10**10, callback=_Snapshots(chosen, env.action_repeat))
    return 0


if __name__ == "__main__":
    sys.exit(main())
