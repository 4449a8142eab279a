"""A trained policy as an ONNX graph, for a robot's controller: raw observation in, controls of the actuators out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rcg_jax.io.tables import write_atomically
from rcg_jax.policies.policy_file import Policy, policy_arrays

#: Version of ONNX's operators: old enough for the runtimes in use.
OPSET = 17


def make_onnx(policy: Policy) -> onnx.ModelProto:
    """The policy's mean action as a graph; the normalisation of observations and the scaling of actions are inside.

    Input ``obs`` (batch, obs_dim) float32, raw. Outputs ``action`` (batch, nu) in [-1, 1] and ``ctrl`` (batch, nu), the
    same in the actuators' units. Each is held for ``action_repeat`` physics steps of ``timestep_s``; the metadata has
    the card's entries.
    """
    card, arrays = policy.card, policy_arrays(policy.actor)
    low, high = (np.asarray(each, np.float32) for each in (card.ctrl_low, card.ctrl_high))
    constants = {
        "obs_mean": arrays["obs_mean"],
        "obs_std": np.sqrt(arrays["obs_var"] + np.float32(card.obs_epsilon)),
        "obs_low": np.float32(-card.obs_clip),
        "obs_high": np.float32(card.obs_clip),
        "action_low": np.float32(card.action_low),
        "action_high": np.float32(card.action_high),
        "ctrl_scale": (high - low) / np.float32(card.action_high - card.action_low),
        "ctrl_offset": low,
        **{name: array for name, array in arrays.items() if name.startswith(("weight_", "bias_"))},
    }
    nodes = [
        helper.make_node("Sub", ["obs", "obs_mean"], ["centred"]),
        helper.make_node("Div", ["centred", "obs_std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "obs_low", "obs_high"], ["layer_0"]),
    ]
    for k in range(len(card.hidden)):
        nodes.append(helper.make_node("Gemm", [f"layer_{k}", f"weight_{k}", f"bias_{k}"], [f"sum_{k}"]))
        nodes.append(helper.make_node("Tanh", [f"sum_{k}"], [f"layer_{k + 1}"]))
    last = len(card.hidden)
    nodes += [
        helper.make_node("Gemm", [f"layer_{last}", f"weight_{last}", f"bias_{last}"], ["mean"]),
        helper.make_node("Clip", ["mean", "action_low", "action_high"], ["action"]),
        helper.make_node("Sub", ["action", "action_low"], ["above"]),
        helper.make_node("Mul", ["above", "ctrl_scale"], ["stretched"]),
        helper.make_node("Add", ["stretched", "ctrl_offset"], ["ctrl"]),
    ]

    def matrix(name: str, columns: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", columns])

    graph = helper.make_graph(
        nodes,
        f"rcg_jax_{card.task}",
        [matrix("obs", card.obs_dim)],
        [matrix("action", card.action_dim), matrix("ctrl", card.action_dim)],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="rcg_jax")
    model.ir_version = 8
    helper.set_model_props(
        model,
        {
            "task": card.task,
            "observation": ", ".join(f"{part.name} [{part.unit}] {part.size}" for part in card.observation),
            "actuators": ", ".join(card.actuators),
            "timestep_s": str(card.timestep_s),
            "action_repeat": str(card.action_repeat),
        },
    )
    onnx.checker.check_model(model)
    return model


def save_onnx(policy: Policy, path: str | Path) -> None:
    """Writes :func:`make_onnx`, atomically.

    Raises:
        OSError: it cannot be written.
    """
    write_atomically(Path(path), make_onnx(policy).SerializeToString())
