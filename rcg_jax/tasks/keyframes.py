"""What a model's keyframes say about a task's goal state beyond its positions."""

from __future__ import annotations

import mujoco
import numpy as np

#: A keyframe is that of a state where no position differs by more [rad, m].
_SAME = 1e-3


def same_pose(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray, *, anywhere: bool = False) -> bool:
    """Whether two positions (nq,) are one pose; with ``anywhere``, wherever a free body is."""
    change = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, a, b)
    if anywhere:
        for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
            change[model.jnt_dofadr[joint] :][:3] = 0
    return bool(np.abs(change).max(initial=0.0) <= _SAME)


def place_mocap(model: mujoco.MjModel, goal_state: np.ndarray) -> None:
    """Puts the mocap bodies where the first keyframe of the goal state (nq,) has them; without one, they stay.

    Nothing in an episode moves them, so that their pose is the model's, and no state: the one that every ``MjData`` of
    the model, and every engine, begins with.
    """
    for qpos, mpos, mquat in zip(model.key_qpos, model.key_mpos, model.key_mquat, strict=True):
        if same_pose(model, qpos, goal_state):
            bodies = np.flatnonzero(model.body_mocapid >= 0)
            order = model.body_mocapid[bodies]
            quat = mquat.reshape(-1, 4)[order]
            model.body_pos[bodies] = mpos.reshape(-1, 3)[order]
            model.body_quat[bodies] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
            return
