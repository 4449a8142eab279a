"""State of a model that is not in its positions and velocities."""

from __future__ import annotations

import mujoco
import numpy as np


def name_of(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """The name of something in a model, or its number."""
    return mujoco.mj_id2name(model, kind, index) or f"number {index}"


def hidden_state(model: mujoco.MjModel) -> str:
    """The first thing in a model whose next step depends on more than qpos and qvel; empty if there is none.

    An episode would not begin in its start: whatever the one before it left there would go on.
    """
    for i in range(model.nu):
        who = f"actuator {name_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)}"
        if model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE or model.actuator_actnum[i]:
            plugin = " of a plugin" if model.actuator_plugin[i] >= 0 else ""
            return f"an activation{plugin}, of {who}"
        if model.actuator_history[i, 0]:
            return f"a history (nsample, delay) of {who}"
    if model.na:
        return f"{model.na} activations"
    if model.npluginstate:
        stateful = np.flatnonzero(model.plugin_statenum).tolist()
        return f"a state of plugin {name_of(model, mujoco.mjtObj.mjOBJ_PLUGIN, stateful[0])}"
    for i in np.flatnonzero(model.body_mocapid >= 0).tolist():
        who = name_of(model, mujoco.mjtObj.mjOBJ_BODY, i)
        return f"the mocap body {who}, which no action moves (without mocap it is a fixed body)"
    return ""
