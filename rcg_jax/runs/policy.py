"""The policy file of a run: its card, from what was trained and how it was evaluated."""

from __future__ import annotations

import jax
import mujoco
import numpy as np

import rcg_jax
from rcg_jax.config import Config
from rcg_jax.config.class_path import class_name
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.io.manifest import array_digest
from rcg_jax.policies.card import FORMAT, PolicyCard, Score
from rcg_jax.policies.policy_file import policy_arrays
from rcg_jax.rl.policy import OBS_CLIP, OBS_EPSILON, Actor
from rcg_jax.runs.recorder import Evaluation
from rcg_jax.tasks.base import Task

#: Name of the policy's file in a run's folder; the card has the suffix ``.json``.
FILE = "policy.npz"


def make_card(config: Config, task: Task, actor: Actor, iteration: int, evaluation: Evaluation) -> PolicyCard:
    """The card of a policy after so many iterations: how it was trained, on what, and its success on rho_0.

    Raises:
        ValueError: the task's ``observation`` does not fit what it observes.
    """

    def score(successes: int) -> Score:
        low, high = wilson_interval(successes, evaluation.episodes)
        return Score(successes, evaluation.episodes, round(low, 6), round(high, 6))

    model, arrays = task.model, policy_arrays(actor)
    low, high = model.actuator_ctrlrange.T.tolist()
    return PolicyCard(
        format=FORMAT,
        task=class_name(config.task),
        method=class_name(config.method),
        preset=config.preset,
        engine=config.engine,
        seed=config.seed,
        iteration=iteration,
        env_steps=evaluation.env_steps,
        observation=task.observation_parts(),
        obs_epsilon=OBS_EPSILON,
        obs_clip=OBS_CLIP,
        hidden=tuple(config.policy.hidden),
        activation="tanh",
        action_low=-1.0,
        action_high=1.0,
        action_std=tuple(np.exp(arrays["log_std"]).tolist()),
        actuators=tuple(_actuator(model, i) for i in range(model.nu)),
        ctrl_low=tuple(low),
        ctrl_high=tuple(high),
        timestep_s=float(model.opt.timestep),
        action_repeat=config.policy.action_repeat,
        horizon=int(task.horizon),
        stochastic=score(evaluation.successes_stochastic),
        mean=score(evaluation.successes_mean),
        starts_sha256=evaluation.starts_sha256,
        rcg_jax=rcg_jax.__version__,
        jax=jax.__version__,
        mujoco=mujoco.__version__,
        arrays_sha256=array_digest(arrays),
    )


def _actuator(model: mujoco.MjModel, index: int) -> str:
    """Name of an actuator, or of the joint that it drives."""
    drives_joint = model.actuator_trntype[index] == mujoco.mjtTrn.mjTRN_JOINT
    joint: str = model.joint(model.actuator_trnid[index, 0]).name if drives_joint else ""
    return model.actuator(index).name or joint
