"""Small models, each with one thing that is easily stepped wrongly: engine=mjx agrees with C MuJoCo, or refuses."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rcg_jax.physics.mjx import MjxEngine
from rcg_jax.physics.native import NativeEngine
from tests.engine_runs import trajectory


def slider(joint: str = "", motor: str = "<motor name='m' joint='j'/>", option: str = "", rest: str = ""):
    """A ball of 10 cm on a vertical slide above a floor."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option>{option}</option><worldbody>
        <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
        <body pos="0 0 0.3"><joint name="j" type="slide" axis="0 0 1" {joint}/>
        <geom name="ball" size="0.1" density="1000" contype="0" conaffinity="0"/></body></worldbody>
        <actuator>{motor}</actuator>{rest}</mujoco>"""
    )


def runs(model: mujoco.MjModel, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (steps, 4) of both engines, stacked: (2, steps, 4) each."""
    qpos = np.linspace(0, 0.03, 4, dtype=np.float32)[:, None]
    controls = np.ones((steps, 4, 1), np.float32)
    made = [trajectory(engine(model), qpos, controls) for engine in (NativeEngine, MjxEngine)]
    positions, velocities = (np.stack([m[k][..., 0] for m in made]) for k in range(2))
    return positions, velocities


@pytest.mark.parametrize(("condim", "margin", "gap"), [(1, 0.05, 0.04), (3, 0.05, 0.02), (1, 0.0, 0.05)])
def test_contacts_act_from_their_margin_whatever_the_gap(condim: int, margin: float, gap: float) -> None:
    pair = f'<pair geom1="floor" geom2="ball" margin="{margin}" gap="{gap}" condim="{condim}"/>'
    model = slider(rest=f"<contact>{pair}</contact>")
    assert MjxEngine(model).solves_contacts
    positions, velocities = runs(model, 600)
    assert np.abs(velocities[0, -1]).max() < 1e-3
    assert np.abs(positions[0, -1] + 0.3 - (0.1 + margin)).max() < 3e-3
    np.testing.assert_allclose(positions[1], positions[0], atol=1e-4)


@pytest.mark.parametrize("limits", [(0.0, 0.01, 0.05), (-0.005, 0.03, 0.02), (0.01, 0.03, 0.009), (0.0, 0.0002, 0.012)])
def test_both_ends_of_a_range_can_act_at_once(limits: tuple[float, float, float]) -> None:
    low, high, margin = limits
    model = slider(f'limited="true" range="{low} {high}" margin="{margin}"')
    assert MjxEngine(model).solves_contacts
    positions, velocities = runs(model, 100)
    np.testing.assert_allclose(positions[1], positions[0], atol=2e-5)
    np.testing.assert_allclose(velocities[1], velocities[0], atol=2e-3)


DAMPED = "<motor name='m' joint='j' damping='{}'/>"
TENDON = "<tendon><fixed name='t' {}><joint joint='j' coef='1'/></fixed></tendon>"

#: Arguments of ``slider`` without the feature and with it, and how the refusal names it.
LEFT_OUT: dict[str, tuple[dict[str, str], dict[str, str], str]] = {
    "joint damping": ({"joint": "damping='1'"}, {"joint": "damping='1 5'"}, "polynomial damping of joint j"),
    "joint stiffness": (
        {"joint": "stiffness='9'"},
        {"joint": "stiffness='9 5000'"},
        "polynomial stiffness of joint j",
    ),
    "tendon damping": (
        {"rest": TENDON.format("damping='1'")},
        {"rest": TENDON.format("damping='1 5'")},
        "polynomial damping of tendon t",
    ),
    "tendon stiffness": (
        {"rest": TENDON.format("stiffness='9' springlength='0.1'")},
        {"rest": TENDON.format("stiffness='9 5000' springlength='0.1'")},
        "polynomial stiffness of tendon t",
    ),
    "actuator damping": ({}, {"motor": DAMPED.format("3")}, "damping of actuator m"),
    "actuator polynomial": ({}, {"motor": DAMPED.format("0 5")}, "polynomial damping of actuator m"),
    "actuator armature": ({}, {"motor": "<motor name='m' joint='j' armature='3'/>"}, "armature of actuator m"),
    "actuator delay": (
        {},
        {"motor": "<motor name='m' joint='j' gear='100' delay='0.1' nsample='60'/>"},
        "history of actuator m",
    ),
    "damper flag": (
        {"joint": "damping='9'"},
        {"joint": "damping='9'", "option": "<flag damper='disable'/>"},
        "damper",
    ),
    "spring flag": (
        {"joint": "stiffness='50' damping='9'"},
        {"joint": "stiffness='50' damping='9'", "option": "<flag spring='disable'/>"},
        "spring",
    ),
    "narrow joint": (
        {"option": "<flag eulerdamp='disable'/>"},
        {
            "joint": "limited='true' range='0 0.01' margin='0.05'",
            "option": "<flag eulerdamp='disable'/>",
        },
        "both limits at once of joint j",
    ),
    "narrow tendon": (
        {"rest": TENDON.format("")},
        {"rest": TENDON.format("limited='true' range='0 0.01' margin='0.05'")},
        "both limits at once of tendon t",
    ),
}


@pytest.mark.parametrize("case", LEFT_OUT)
def test_what_mjx_would_leave_out_is_refused(case: str) -> None:
    without, having, what = LEFT_OUT[case]
    MjxEngine(slider(**without))
    with pytest.raises(NotImplementedError) as error:
        MjxEngine(slider(**having))
    message = str(error.value)
    assert what in message
    assert message.endswith("(engine=native can)")
    assert "\n" not in message
    # It is no trifle: C MuJoCo's trajectories differ.
    ends = []
    for arguments in (without, having):
        data = mujoco.MjData(slider(**arguments))
        data.qvel[:], data.ctrl[:] = 1.0, 1.0
        mujoco.mj_step(slider(**arguments), data, 50)
        ends.append(data.qpos[0])
    assert abs(ends[0] - ends[1]) > 1e-3
