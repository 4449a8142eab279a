"""An arm whose actuators have activations, as a task, and what C MuJoCo makes of it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from rcg_jax import Task
from rcg_jax.tasks.check import build_task

MODEL = """
<mujoco model="arm"><compiler angle="radian"/>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>{world}
    <site name="anchor" pos="0 0 .3"/>
    <body name="upper"><joint name="a" axis="0 1 0" damping="1" range="-1 1" limited="true"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1" contype="0" conaffinity="0"/>
      <site name="mid" pos=".2 0 .05"/>
      <body pos=".3 0 0"><joint name="b" axis="0 1 0" damping="1" range="-1 1" limited="true"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5" contype="0" conaffinity="0"/>
        <site name="tip" pos=".2 0 0"/></body></body>
  </worldbody>
  <tendon><spatial name="t"><site site="anchor"/><site site="mid"/></spatial></tendon>
  <actuator>{actuators}</actuator>
  {rest}
</mujoco>"""

#: Kinds of actuators with an activation that MJX has, too; each on a joint or a tendon of the arm.
KINDS = {
    "integrator": '<intvelocity joint="a" kp="10" ctrlrange="-1 1" actrange="-.6 .6"/>',
    "filter": '<general joint="a" dyntype="filter" dynprm=".1" gainprm="3" ctrlrange="-1 1"/>',
    "filterexact": '<position joint="b" kp="10" timeconst=".1" ctrlrange="-1 1"/>',
    "limited": '<general joint="b" dyntype="filter" dynprm=".05" gainprm="3" ctrlrange="-1 1" actlimited="true"'
    ' actrange="-.2 .3"/>',
    "muscle": '<muscle tendon="t" ctrlrange="0 1" lengthrange=".1 .6" force="20" tausmooth=".2"/>',
}
MOTOR = '<motor joint="b" ctrlrange="-1 1"/>'
#: An integrator, a motor without activation, a filter and a muscle.
SEVERAL = KINDS["integrator"] + MOTOR + KINDS["filterexact"] + KINDS["muscle"]


def model_of(actuators: str = SEVERAL, *, world: str = "", rest: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL.format(actuators=actuators, world=world, rest=rest))


class Arm(Task):
    """The tip has to come to where it is at (0.4, -0.3)."""

    horizon = 40
    goal_state = np.array([0.4, -0.3])
    search = {"num_states": 20, "num_found": 40, "num_walks": 16, "walk_length": 20, "grid": 0.05, "max_rounds": 3}  # noqa: RUF012
    actuators, rest = SEVERAL, ""

    def make_model(self) -> mujoco.MjModel:
        return model_of(self.actuators, rest=self.rest)

    def observe(self, s: Any) -> Any:
        return jnp.concatenate([s.qpos, s.qvel, *([] if s.act is None else [s.act])])

    def distance(self, s: Any) -> Any:
        return jnp.linalg.norm(s.qpos - jnp.array([0.4, -0.3]))

    def is_goal(self, s: Any) -> Any:
        return self.distance(s) < 0.1

    def is_feasible(self, s: Any) -> Any:
        return self.distance(s) < 1.0


def arm(engine: str = "native", **attributes: Any) -> Task:
    return build_task(type("Variant", (Arm,), {"__module__": __name__, **attributes}), engine)


def c_mujoco(model: mujoco.MjModel, start: list[np.ndarray], controls: np.ndarray) -> list[np.ndarray]:
    """Positions, velocities and activations (T, B, n) of B simulations from rest in ``start``, under (T, B, nu)."""
    paths = []
    for qpos, act, ctrls in zip(*start, controls.swapaxes(0, 1), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.act[:] = qpos, act
        rows = []
        for ctrl in ctrls:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
            rows.append([data.qpos.copy(), data.qvel.copy(), data.act.copy()])
        paths.append(rows)
    return [np.array([[row[k] for row in rows] for rows in paths]).swapaxes(0, 1) for k in range(3)]
