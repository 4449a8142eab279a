"""Policies as ONNX graphs: the same actions, in ONNX Runtime, and controls in the actuators' units."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from rcg_jax import export, load_policy
from rcg_jax.policies.policy_file import shipped_policies

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")


@pytest.mark.parametrize("name", shipped_policies())
def test_the_graph_acts_like_the_policy(name: str, tmp_path: Path) -> None:
    out = tmp_path / "policy.onnx"
    assert export.main([f"policy={name}", f"out={out}"]) == 0
    policy = load_policy(name)
    obs = 3 * np.asarray(jax.random.normal(jax.random.key(0), (50, policy.card.obs_dim)), np.float32)
    session = onnxruntime.InferenceSession(out)
    action, ctrl = session.run(["action", "ctrl"], {"obs": obs})
    np.testing.assert_allclose(action, policy.mean(obs), atol=1e-5)
    low, high = np.array(policy.card.ctrl_low), np.array(policy.card.ctrl_high)
    np.testing.assert_allclose(ctrl, low + (np.asarray(policy.mean(obs)) + 1) / 2 * (high - low), atol=1e-3)
    assert session.get_modelmeta().custom_metadata_map["action_repeat"] == str(policy.card.action_repeat)


def test_another_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main(["policy=ring_peg", "out=policy.pt"]) == 2
    assert "out=policy.pt: must end in .onnx" in capsys.readouterr().err
    assert export.main(["policy=ring_peg"]) == 2
    assert "out=FILE.onnx is missing" in capsys.readouterr().err
