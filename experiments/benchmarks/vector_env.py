"""What the Gymnasium vector environment leaves of the speed of ``mujoco.batch``, under random actions.

    python -m experiments.benchmarks.vector_env                 # writes vector_env.csv; --help lists the settings

Both go through the same states: what the environment did in a stretch of steps, resets included, ``mujoco.batch`` does
again without it, right afterwards, so that their ratio means something on a machine whose load changes.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mujoco.batch import Batch

from experiments.common import RESULTS, in_one_line, machine, options, write_rows
from rcg_jax.config.settings import option
from rcg_jax.gymnasium import TaskVectorEnv, make_vec

#: Part of a simulation's state.
Fields = list[np.ndarray]


@dataclass(frozen=True)
class VectorEnvOptions:
    """Settings of ``python -m experiments.benchmarks.vector_env``."""

    tasks: str = option("point_maze,ant_maze,ring_peg,key_insertion", "tasks")
    num_envs: int = option(256, "environments", low=1)
    stretches: int = option(40, "stretches of 20 actions, or 60 that are held for one step", low=1)
    out: str = option(str(RESULTS / "vector_env.csv"), "file *.csv")


@in_one_line
def main() -> int:
    """Measures each task."""
    chosen = options(VectorEnvOptions, "experiments.benchmarks.vector_env")
    rows = []
    for task in chosen.tasks.split(","):
        env = make_vec(task, chosen.num_envs)
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        length = 20 if env.action_repeat > 1 else 60
        shape = (length, *(env.action_space.shape or ()))
        ours, raw = np.array(
            [_stretch(env, rng.uniform(-1, 1, shape).astype(np.float32)) for _ in range(chosen.stretches)]
        ).T[:, 1:]  # the first one compiles
        steps = length * env.action_repeat * chosen.num_envs
        row = {
            "task": task,
            "num_envs": chosen.num_envs,
            "action_repeat": env.action_repeat,
            "env_steps_per_s": round(steps / np.median(ours)),
            "raw_steps_per_s": round(steps / np.median(raw)),
            "ratio": round(float(np.median(raw / ours)), 3),
        }
        rows.append({**row, **machine()})
        print(row, flush=True)
    write_rows(Path(chosen.out), rows)
    return 0


def _stretch(env: TaskVectorEnv, actions: np.ndarray) -> tuple[float, float]:
    """Seconds of the environment and of ``mujoco.batch`` for ``actions`` (n, B, nu)."""
    before, state, key = _fields(env), env._env, env._key
    begin = time.perf_counter()
    for action in actions:
        env.step(action)
    ours = time.perf_counter() - begin
    env._env, env._key = state, key
    resets = []
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        done = np.flatnonzero(terminated | truncated)
        resets.append((done, [field[done] for field in _fields(env)]))
    model = env.task.model
    batch = Batch(model, env.num_envs)
    state_fields = [batch.bind(name) for name in ("qpos", "qvel", "qacc_warmstart")]
    controls, (low, high) = batch.bind("ctrl"), model.actuator_ctrlrange.T
    for field, value in zip(state_fields, before):
        field[:] = value
    begin = time.perf_counter()
    for action, (done, fresh) in zip(actions, resets):
        controls[:] = low + (action + 1) / 2 * (high - low)
        for _ in range(env.action_repeat):
            batch.step()
        for field, value in zip(state_fields, fresh):
            field[done] = value
    return ours, time.perf_counter() - begin


def _fields(env: TaskVectorEnv) -> Fields:
    assert env._env is not None
    physics = env._env.physics
    return [np.array(x, float) for x in (physics.qpos, physics.qvel, physics.qacc_warmstart)]


if __name__ == "__main__":
    sys.exit(main())
