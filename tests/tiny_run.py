"""A task that MuJoCo simulates in no time, and saved runs of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from rcg_jax import tasks as registry
from rcg_jax.config.settings import BaselineConfig, Config, CurriculumConfig, PolicyConfig, RolloutConfig, TrpoConfig
from rcg_jax.io.starts_file import encode_starts
from rcg_jax.runs import checkpoint
from rcg_jax.runs.folder import RunFolder
from rcg_jax.tasks import Task
from rcg_jax.train_step import TrainState, init_train_state
from rcg_jax.types import Snapshot, StartLabels

XML = """
<mujoco model="tiny">
  <option timestep="0.02" gravity="0 0 0"/>
  <statistic center="0.2 0 0" extent="0.7"/>
  <visual><global offwidth="320" offheight="240"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="1 1 0.1" rgba="0.9 0.9 0.9 1"/>
    <site name="goal" pos="0.2 0 0.05" size="0.03" rgba="0 1 0 1"/>
    <body name="ball" pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0" damping="3"/>
      <joint name="y" type="slide" axis="0 1 0" damping="3"/>
      <geom type="sphere" size="0.05" mass="1" rgba="0.8 0.1 0.1 1" contype="0" conaffinity="0"/>
      <site name="centre" size="0.01"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" ctrlrange="-4 4"/><motor joint="y" ctrlrange="-4 4"/></actuator>
</mujoco>
"""


class Tiny(Task):
    """A ball on a table has to come within 10 cm of a point."""

    name = "tiny"
    horizon = 50

    def __init__(self, engine: str = "mjx") -> None:
        super().__init__(engine)
        self._centre = self.model.site("centre").id
        self._goal = jnp.asarray(self.model.site("goal").pos, jnp.float32)

    @property
    def goal_state(self) -> np.ndarray:
        return np.array([0.2, 0.0])

    def observe(self, s: Snapshot) -> Array:
        return jnp.concatenate([s.qpos, s.qvel])

    def distance(self, s: Snapshot) -> Array:
        return jnp.linalg.norm(s.site_xpos[self._centre] - self._goal)

    def is_goal(self, s: Snapshot) -> Array:
        return self.distance(s) < 0.1

    def is_feasible(self, s: Snapshot) -> Array:
        return self.distance(s) < 0.6


def register(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Makes the task known, with its model and feasible starts in ``folder``."""
    rng = np.random.default_rng(0)
    radius, angle = rng.uniform(0.15, 0.55, 300), rng.uniform(0, 2 * np.pi, 300)
    starts = np.stack([0.2 + radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    (folder / "tiny.xml").write_text(XML)
    (folder / "tiny.npz").write_bytes(encode_starts(starts))
    patch.setattr(Tiny, "xml", folder / "tiny.xml", raising=False)
    patch.setattr(Tiny, "feasible_file", folder / "tiny.npz", raising=False)
    patch.setitem(registry.TASKS, "tiny", Tiny)


def config(run_dir: Path) -> Config:
    """Settings of a run that takes no time."""
    return dataclasses.replace(
        Config(),
        task="tiny",
        engine="native",
        run_dir=str(run_dir),
        curriculum=CurriculumConfig(num_new=20, num_old=10, num_candidates=200, brownian_horizon=10),
        rollout=RolloutConfig(num_envs=20, batch_size=1000),
        trpo=TrpoConfig(iterations=2),
        policy=PolicyConfig(hidden=[8]),
        baseline=BaselineConfig(hidden=[8], minibatch_size=100),
    )


def save_run(run_dir: Path, *, iterations: tuple[int, ...] = (3,)) -> Path:
    """Writes a run with one checkpoint per number in ``iterations``; returns its folder."""
    folder = RunFolder(config(run_dir), seed=0)
    folder.open()
    folder.write_config()
    folder.close()
    state = trained(folder.config)
    for iteration in iterations:
        checkpoint.save([folder.checkpoints], iteration, [state.replace(iteration=jnp.int32(iteration))])
    return folder.path


def trained(config: Config) -> TrainState:
    """A state with known answers.

    Its policy pushes along x: it succeeds from starts on the goal's left at the same y, and only from those. Of its 30
    starts, 10 are mastered, 10 good, 5 too hard, and 5 had no episode.
    """
    task = registry.make_task("tiny", "native")
    state = init_train_state(config, task, 0)
    push = jax.tree.map(jnp.zeros_like, state.agent.policy.mlp)
    push["params"]["Dense_1"]["bias"] = jnp.array([0.5, 0.0])
    policy = state.agent.policy.replace(mlp=push, log_std=jnp.full(2, -1.0))
    rows = jnp.arange(30)
    return state.replace(
        agent=state.agent.replace(policy=policy),
        starts=task.feasible_starts().take(rows),
        labels=StartLabels(
            successes=jnp.where(rows < 10, 4, jnp.where(rows < 20, 2, 0)),
            episodes=jnp.where(rows < 25, 4, 0),
            steps=jnp.where(rows < 20, 40, 0),
        ),
    )
