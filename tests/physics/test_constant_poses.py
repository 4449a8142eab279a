"""Mocap bodies stand still, where the goal state has them, on every engine; quaternions stay what they are."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import Task
from rcg_jax.curriculum.feasible import canonical_quaternions, cells
from rcg_jax.curriculum.sample_nearby import brownian_walks
from rcg_jax.tasks.check import build_task, check_task

#: A ball on a rail, tied by a spring to a hand that no joint moves, and a plate on the hand that stops it.
HAND = """
<mujoco model="hand">
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="hand" mocap="true" pos="1 0 0"><site name="pull"/>{plate}</body>
    <body name="ball"><joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <geom name="ball" size=".05" mass="1" contype="0" conaffinity="0"/><site name="centre"/></body>
  </worldbody>
  <tendon>{spring}</tendon>
  <contact>{pair}</contact>
  <actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
  <keyframe>
    <key name="other" qpos=".3" mpos="5 5 5"/>
    <key name="goal" qpos=".1" mpos=".5 0 0" mquat="0 0 0 2"/>
  </keyframe>
</mujoco>"""
PARTS = {
    "spring": {
        "spring": '<spatial stiffness="20"><site site="pull"/><site site="centre"/></spatial>',
        "plate": "",
        "pair": "",
    },
    "plate": {
        "spring": "",
        "plate": '<geom name="plate" type="plane" size="1 1 .1" quat="1 0 1 0" contype="0" conaffinity="0"/>',
        "pair": '<pair geom1="plate" geom2="ball" condim="1"/>',
    },
}


class Hand(Task):
    """The ball has to come to x = 0.1, or wherever the class says."""

    horizon = 50
    goal = 0.1
    parts = "spring"

    @property
    def goal_state(self) -> np.ndarray:
        return np.array([self.goal])

    def make_spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(HAND.format(**PARTS[self.parts]))

    def observe(self, s: Any) -> Any:
        return jnp.concatenate([s.qpos, s.qvel, s.xpos[self.model.body("hand").id]])

    def distance(self, s: Any) -> Any:
        return jnp.abs(s.qpos[0] - self.goal)

    def is_goal(self, s: Any) -> Any:
        return self.distance(s) < 0.05

    def is_feasible(self, s: Any) -> Any:
        return self.distance(s) < 2.0


def made(base: type[Task], engine: str = "native", **attributes: Any) -> Task:
    return build_task(type("Variant", (base,), {"__module__": __name__, **attributes}), engine)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
@pytest.mark.parametrize("parts", PARTS)
def test_a_mocap_body_stands_where_the_keyframe_of_the_goal_state_has_it(parts: str, engine: str) -> None:
    task = made(Hand, engine, parts=parts)
    check_task(task, starts=False)
    state, action = task.reset(task.goal_starts()), jnp.full((1, 1), 0.5)
    plain = Hand.make_spec(task).compile()  # type: ignore[arg-type]
    data = mujoco.MjData(plain)
    mujoco.mj_resetDataKeyframe(plain, data, plain.key("goal").id)
    data.ctrl[:] = 0.5
    step = jax.jit(task.step)
    for _ in range(100):
        state = step(state, action)
        mujoco.mj_step(plain, data)
    np.testing.assert_allclose(state.qpos[0], data.qpos, atol=1e-4)
    mujoco.mj_forward(plain, data)
    s = task.snapshot(state)
    np.testing.assert_allclose(s.xpos[0], data.xpos, atol=1e-4)
    np.testing.assert_allclose(s.xmat[0].reshape(-1, 9), data.xmat, atol=1e-5)
    np.testing.assert_allclose(s.com[0], data.xpos[task.model.body("ball").id], atol=1e-4)  # of what moves
    # Without a keyframe of the goal state it stands where the model has it.
    other = made(Hand, engine, parts=parts, goal=0.2)
    np.testing.assert_array_equal(other.snapshot(other.reset(other.goal_starts())).xpos[0, 1], [1.0, 0.0, 0.0])


TUMBLING = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
  <body name="loose"><freejoint/><geom type="box" size=".1 .2 .3" contype="0" conaffinity="0"/><site name="s"/>
    <body pos=".5 0 0"><joint type="ball"/><geom type="box" size=".3 .1 .1" contype="0" conaffinity="0"/></body></body>
  </worldbody><actuator>{motors}</actuator></mujoco>"""


class Tumbling(Task):
    """A box with a box on a ball joint, both with motors."""

    goal_state = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0.0])

    def make_spec(self) -> mujoco.MjSpec:
        gears = ("1 2 3 0 0 0", "0 0 0 9 1 0", "0 0 0 0 9 1", "0 0 0 1 0 9")
        return mujoco.MjSpec.from_string(
            TUMBLING.format(motors="".join(f'<motor site="s" gear="{gear}" ctrlrange="-1 1"/>' for gear in gears))
        )

    def observe(self, s: Any) -> Any:
        return s.qpos

    def distance(self, s: Any) -> Any:
        return jnp.linalg.norm(s.qpos[:3])

    def is_goal(self, s: Any) -> Any:
        return self.distance(s) < 0.1

    def is_feasible(self, s: Any) -> Any:
        return self.distance(s) < 100.0


@pytest.mark.parametrize("engine", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_quaternions_of_walks_have_length_one(engine: str) -> None:
    task = made(Tumbling, engine)
    walks = jax.jit(
        lambda: brownian_walks(
            task, jax.random.key(0), task.goal_starts(), num_walks=8, num_snapshots=5, walk_length=300, noise_std=1.0,
            noise="integrated",
        )
    )()  # fmt: skip
    quats = np.asarray(walks.qpos)[np.asarray(walks.valid)].reshape(-1, 11)[:, 3:].reshape(-1, 2, 4)
    assert np.abs(quats[..., 0]).min() < 0.5  # they did turn
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1.0, atol=1e-6)


def test_a_quaternion_and_its_negative_are_in_one_cell() -> None:
    task = made(Tumbling)
    qpos = np.random.default_rng(0).normal(size=(50, 11)).astype(np.float32)
    qpos[:10, 3] = 0.0  # half a turn
    qpos[:5, 4] = 0.0
    flipped = qpos.copy()
    flipped[:, 3:7] *= -1
    flipped[::2, 7:] *= -1

    def cell(positions: np.ndarray) -> np.ndarray:
        return cells(task.grid_coordinates(canonical_quaternions(task.model, positions)), 0.1)

    assert (cells(qpos, 0.1) != cells(flipped, 0.1)).any(axis=1).all()
    np.testing.assert_array_equal(cell(flipped), cell(qpos))
    np.testing.assert_array_equal(canonical_quaternions(task.model, qpos)[:, :3], qpos[:, :3])
    assert len(np.unique(cell(qpos), axis=0)) == 50
    without = np.array([[-1.0, 2.0]], np.float32)
    hinge = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    np.testing.assert_array_equal(canonical_quaternions(hinge, without), without)
