"""Neutral controls against C MuJoCo: what holds a pose of servos, what a keyframe says, what ranges models imply."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import Task
from rcg_jax.curriculum.sample_nearby import brownian_walks
from rcg_jax.curriculum.settle import settle
from rcg_jax.tasks.actuators import give_ranges, neutral_control
from rcg_jax.tasks.check import build_task, check_task
from rcg_jax.types import StartSet

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.01"/>
  <worldbody>
    <body pos="0 0 .8"><joint name="a" axis="0 1 0" range="-1.8 1.3" damping="1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5" contype="0" conaffinity="0"/>
      <body pos=".3 0 0"><joint name="b" axis="0 1 0" range="-3 -.1" damping="1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".3" contype="0" conaffinity="0"/></body></body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed></tendon>
  <actuator>{actuators}</actuator>
  <keyframe><key name="home" qpos=".9 -.6" ctrl="{ctrl}"/></keyframe>
</mujoco>"""
SERVOS = '<position joint="a" kp="60"/><position joint="b" kp="60" gear="2"/>'


def model_of(actuators: str = SERVOS, ctrl: str = "0 0") -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(ARM.format(actuators=actuators, ctrl=ctrl))
    give_ranges(model)
    return model


def forces(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos, ctrl
    mujoco.mj_forward(model, data)
    return data.actuator_force.copy()


@pytest.mark.parametrize(
    "actuators",
    [
        SERVOS,
        '<position joint="a" kp="60" kv="5" gear="-1"/><velocity joint="b" kv="3" ctrlrange="-1 1"/>',
        '<position tendon="both" kp="30" ctrlrange="-4 4"/><motor joint="a" ctrlrange="0 9"/>',
        '<general joint="a" gainprm="20" biastype="affine" biasprm="3 -10 -1" ctrlrange="-9 9"/>'
        '<motor joint="b" ctrlrange="-1 3"/>',
    ],
)
def test_the_neutral_control_exerts_no_force_at_rest(actuators):
    model = model_of(actuators)
    offset, slope = neutral_control(model, np.array([0.9, -0.6]))
    for qpos in np.array([[0.9, -0.6], [0.0, -2.0], [-1.0, -0.2]]):
        np.testing.assert_allclose(forces(model, qpos, offset + slope @ qpos), 0, atol=1e-9)


def test_a_keyframe_of_the_goal_state_says_what_holds_it():
    """A motor keeps what the keyframe compensates; a servo is shifted by as much everywhere."""
    model = model_of(SERVOS, ctrl="1.0 -1.1")
    offset, slope = neutral_control(model, np.array([0.9, -0.6]))
    np.testing.assert_allclose(offset + slope @ [0.9, -0.6], [1.0, -1.1])
    np.testing.assert_allclose(offset + slope @ [0.0, -1.0], [0.1, -1.9])
    motors = '<motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/>'
    hover = model_of(motors, ctrl="2 -3")
    np.testing.assert_allclose(neutral_control(hover, np.array([0.9, -0.6]))[0], [2, -3])
    np.testing.assert_allclose(neutral_control(hover, np.array([0.5, -0.6]))[0], [0, 0])


def test_ranges_that_a_model_implies():
    model = model_of(
        '<position joint="a" kp="60"/><position joint="b" kp="60" gear="-2"/>'
        '<motor joint="a" forcerange="-8 4" gear="3"/><velocity joint="b" kv="1"/>'
    )
    assert model.actuator_ctrllimited.tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(model.actuator_ctrlrange[:3], [[-1.8, 1.3], [0.2, 6], [-8, 4]])


class Arm(Task):
    """Two position servos; the goal pose is far from the middle of their ranges."""

    horizon = 100
    settle_steps = 50
    actuators = SERVOS.replace(' gear="2"', "")

    def make_model(self):
        return mujoco.MjModel.from_xml_string(ARM.format(actuators=self.actuators, ctrl="0 0"))

    @property
    def goal_state(self):
        return np.array([0.9, -0.6])

    def observe(self, s):
        return jnp.concatenate([s.qpos, s.qvel])

    def distance(self, s):
        return jnp.linalg.norm(s.qpos - jnp.array([0.9, -0.6]))

    def is_goal(self, s):
        return self.distance(s) < 0.2

    def is_feasible(self, s):
        return self.distance(s) < 4.0


def test_servos_settle_and_walk_from_where_they_are():
    task = build_task(Arm, "native")
    check_task(task, starts=False)  # the middle of the ranges would take the goal state a radian away
    poses = jnp.asarray([[0.9, -0.6], [0.0, -1.5], [-1.0, -2.5]], jnp.float32)
    stays, drift = jax.jit(lambda: settle(task, StartSet.at_rest(poses, 2), 50))()
    assert stays.all()
    assert (drift < 0.1).all()  # what gravity makes them give way
    for noise in ("white", "integrated"):
        walks = jax.jit(
            lambda noise=noise: brownian_walks(
                task,
                jax.random.key(0),
                task.goal_starts(),
                num_walks=200,
                num_snapshots=10,
                walk_length=10,
                noise_std=0.05,
                noise=noise,
            )
        )()
        assert walks.valid.all()
        ends = np.asarray(walks.qpos).reshape(10, 200, 2)[-1]
        assert np.abs(ends.mean(axis=0) - [0.9, -0.6]).max() < 0.15  # not drawn to the middle, 1.15 rad away


def test_a_task_may_give_its_own():
    class Held(Arm):
        def neutral_action(self, qpos):
            return jnp.full((*qpos.shape[:-1], 2), 0.25)

    task = build_task(Held, "native")
    low, high = task.model.actuator_ctrlrange.T
    from rcg_jax.tasks.check_model import neutral_ctrl

    np.testing.assert_allclose(neutral_ctrl(task, task.goal_state), low + 0.625 * (high - low), rtol=1e-6)
