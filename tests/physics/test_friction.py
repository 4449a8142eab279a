"""engine=mjx's sliding friction and free joints, against C MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rcg_jax.physics.contact_solver import constraints
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine
from tests.engine_runs import trajectory


def scene(plane: str, contact: str, option: str = "") -> mujoco.MjModel:
    """A free body with a swinging arm, above a plane and beside a fixed ball."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.005" {option}><flag autoreset="disable"/></option>
        <default><geom contype="0" conaffinity="0"/></default>
        <worldbody><geom name="floor" type="plane" size="1 1 1" {plane}/><geom name="ball" size="0.1" pos="0.25 0 0.1"/>
          <body><freejoint/><geom name="foot" size="0.1"/><geom size="0.05" pos="0.05 0.02 0.1"/>
            <body pos="0 0.1 0"><joint name="arm" axis="1 0 0" range="-1 1" limited="true" armature="0.01"/>
              <geom name="hand" size="0.04" pos="0 0 0.2"/></body>
          </body>
        </worldbody>
        <contact>{contact}</contact>
        <actuator><motor joint="arm" ctrlrange="-1 1"/></actuator></mujoco>"""
    )


def pairs(condim: int, friction: str) -> str:
    return "".join(
        f'<pair geom1="{a}" geom2="{b}" condim="{condim}" friction="{friction}" margin="0.002"/>'
        for a, b in (("floor", "foot"), ("floor", "hand"), ("ball", "foot"), ("ball", "hand"))
    )


def thrown(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    qpos = np.zeros((32, model.nq), np.float32)
    qpos[:, :3] = rng.uniform([-0.1, -0.1, 0.1], [0.06, 0.1, 0.12], (32, 3))
    quat = np.array([1, 0, 0, 0]) + 0.3 * rng.standard_normal((32, 4))
    qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return qpos, rng.uniform(-1, 1, (60, 32, 1)).astype(np.float32)


@pytest.mark.parametrize(
    ("plane", "friction"),
    [("", "1 1"), ('euler="20 0 0"', "0.3 0.8"), ('euler="-80 10 30" pos="0 0 0.1"', "1 0.5")],
    ids=["flat", "tilted", "steep"],
)
def test_sliding_free_bodies_move_as_in_c_mujoco(plane: str, friction: str) -> None:
    model = scene(plane, pairs(3, friction), 'impratio="2"')
    assert constraints.supported(model)
    native, mjx = (trajectory(engine(model), *thrown(model)) for engine in (NativeEngine, MjxEngine))
    for a, b, bound in zip(native, mjx, (1e-4, 5e-3)):
        assert np.abs(a).max() > 0.05
        assert np.median(np.abs(a - b).max((0, 2))) < bound / 10
        assert np.sort(np.abs(a - b).max((0, 2)))[-2] < bound
    # The friction matters here: without it they are elsewhere.
    smooth = trajectory(NativeEngine(scene(plane, pairs(1, friction), 'impratio="2"')), *thrown(model))
    assert np.median(np.abs(smooth[0] - native[0]).max((0, 2))) > 1e-3
