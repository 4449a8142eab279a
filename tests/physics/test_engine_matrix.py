"""engine=mjx against C MuJoCo over a matrix of features: each is simulated as C MuJoCo does, or refused in words."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rcg_jax.physics.engine import UnsupportedModelError
from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine
from tests.engine_matrix import FEATURES, REFUSED, model_text
from tests.engine_runs import trajectory

#: What is simulated and stands for most of the others in the fast suite.
FAST = ("joint springs", "fixed tendon", "position")


def load(feature: str) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(model_text(feature))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model


@pytest.mark.parametrize("feature", sorted(REFUSED))
def test_what_mjx_lacks_is_refused(feature: str) -> None:
    model = load(feature)
    with pytest.raises(UnsupportedModelError, match=r"MJX cannot simulate this model: .* \(engine=native can\)"):
        MjxEngine(model)


@pytest.mark.parametrize(
    "feature", [pytest.param(f, marks=() if f in FAST else pytest.mark.slow) for f in FEATURES if f not in REFUSED]
)
def test_what_mjx_takes_it_simulates(feature: str) -> None:
    """40 steps from rest under the same random controls."""
    model = load(feature)
    controls = np.random.default_rng(0).uniform(*model.actuator_ctrlrange.T, (40, 1, model.nu)).astype(np.float32)
    made = [
        trajectory(engine(model), model.qpos0[None].astype(np.float32), controls)
        for engine in (MjxEngine, NativeEngine)
    ]
    np.testing.assert_allclose(made[0][0], made[1][0], atol=2e-4)
