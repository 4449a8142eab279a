"""Training throughput against sb3-contrib's TRPO, measured in turns in one run on the same machine.

Same MJCF, task, network, batch and TRPO settings; both start from the feasible set (``method=uniform``), because a
peer has no curriculum. The peer steps C MuJoCo through Gymnasium, in the fastest of several vectorisations.

    make bench-peer                        # installs the peer, then: python -m experiments.bench_peer
    python -m experiments.bench_peer rounds=3 out=experiments/results/bench_peer.csv
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from experiments.report import arguments, machine, write_rows
from rcg_jax.config.settings import Config, PolicyConfig
from rcg_jax.physics.jit import jit
from rcg_jax.rl.sizes import batch_size
from rcg_jax.tasks import make_task
from rcg_jax.train_step import init_train_state, make_train_step

GOAL_RADIUS = 0.03
HORIZON = 500


class RingPegEnv(gymnasium.Env):
    """ring_peg through Gymnasium: the same MJCF, starts, observation, reward and termination."""

    def __init__(self, xml: str, starts: np.ndarray) -> None:
        self._model = mujoco.MjModel.from_xml_path(xml)
        self._data = mujoco.MjData(self._model)
        self._starts = starts
        self._goal = self._model.site("goal").pos.copy()
        self._disk = self._data.site("disk")
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (17,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)

    def _observation(self) -> np.ndarray:
        # Only the disk's position has to be brought up to date with qpos; nothing else is read.
        mujoco.mj_kinematics(self._model, self._data)
        return np.concatenate([self._data.qpos, self._data.qvel, self._disk.xpos]).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._starts[self.np_random.integers(len(self._starts))]
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._data.ctrl[:] = action
        mujoco.mj_step(self._model, self._data)
        observation = self._observation()
        goal = bool(np.linalg.norm(self._disk.xpos - self._goal) < GOAL_RADIUS)
        return observation, float(goal), goal, False, {}


def peer(config: Config, xml: str, starts: np.ndarray, vec: type, num_envs: int, batch: int) -> Callable[[], float]:
    """A function that trains the peer for one TRPO iteration and returns its env steps per second."""

    def make() -> gymnasium.Env:
        return gymnasium.wrappers.TimeLimit(RingPegEnv(xml, starts), HORIZON)

    cfg = config.trpo
    model = TRPO(
        "MlpPolicy",
        vec([make] * num_envs),
        n_steps=batch // num_envs,
        batch_size=config.baseline.minibatch_size,
        learning_rate=config.baseline.learning_rate,
        gamma=cfg.gamma,
        gae_lambda=cfg.gae_lambda,
        cg_max_steps=cfg.cg_iterations,
        cg_damping=cfg.cg_damping,
        line_search_shrinking_factor=cfg.backtrack_ratio,
        line_search_max_iter=cfg.max_backtracks,
        n_critic_updates=config.baseline.epochs,
        target_kl=cfg.max_kl,
        sub_sampling_factor=max(1, round(1 / cfg.fisher_fraction)),
        policy_kwargs={
            "net_arch": {"pi": list(config.policy.hidden), "vf": list(config.baseline.hidden)},
            "activation_fn": torch.nn.Tanh,
        },
        device="cpu",
        seed=0,
    )

    def run() -> float:
        begin = time.perf_counter()
        model.learn(batch, reset_num_timesteps=False)
        return batch / (time.perf_counter() - begin)

    return run


def ours(config: Config) -> Callable[[], float]:
    """A function that runs one compiled train step of ours and returns env steps per second."""
    task = make_task(config.task, config.engine)
    step = jit(make_train_step(config, task), fusion_emitters=task.engine.fusion_emitters)
    state = [init_train_state(config, task, 0)]

    def run() -> float:
        begin = time.perf_counter()
        state[0], _ = jax.block_until_ready(step(state[0]))
        return batch_size(config, task) * config.trpo.iterations / (time.perf_counter() - begin)

    run()  # compile
    return run


def main() -> None:
    """Measures and writes the CSV."""
    args = arguments({"rounds": 3, "out": "experiments/results/bench_peer.csv"})
    # The peer acts in every step of physics, and so do we here.
    config = Config(engine="native", method="uniform", policy=PolicyConfig(action_repeat=1))
    task = make_task(config.task, config.engine)
    batch = batch_size(config, task)
    starts, xml = np.asarray(task.feasible_starts().qpos), str(task.xml)
    contenders = {
        **{f"peer DummyVecEnv {n}": peer(config, xml, starts, DummyVecEnv, n, batch) for n in (1, 8, 25, 125)},
        "peer SubprocVecEnv 8": peer(config, xml, starts, SubprocVecEnv, 8, batch),
        "rcg_jax native": ours(config),
    }
    speeds: dict[str, list[float]] = {name: [] for name in contenders}
    for round_ in range(args["rounds"]):
        for name, run in contenders.items():
            speeds[name].append(run())
            print(f"round {round_ + 1}/{args['rounds']}  {name:22s} {speeds[name][-1]:>10,.0f} env steps/s", flush=True)
    median = {name: float(np.median(values)) for name, values in speeds.items()}
    best = max(value for name, value in median.items() if name.startswith("peer"))
    ratio = median["rcg_jax native"] / best
    about = machine()
    rows = [
        {"name": name, "steps_per_s": round(value), "ratio_to_best_peer": round(value / best, 3)} | about
        for name, value in median.items()
    ]
    write_rows(Path(args["out"]), rows)
    print(f"rcg_jax / best peer = {ratio:.1f} (target >= 5)")
    sys.exit(0 if ratio >= 5 else 1)


if __name__ == "__main__":
    main()
