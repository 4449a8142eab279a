"""Kinds of models that public bug reports led to: what is neutral there, and what is refused and why."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax import Task, make_task
from rcg_jax.curriculum.settle import settle
from rcg_jax.rl.rollout import Sampler, begin, rollout
from rcg_jax.runs import memory
from rcg_jax.tasks.check import ContractError, build_task, check_task
from rcg_jax.types import StartSet
from tests.analytic import Line, make_starts

BODY = '<body><joint name="x" {joint}/><geom name="ball" {geom}/>{more}</body>'
SPHERE = 'type="sphere" size=".05" mass="1"'


def model(joint: str, actuators: str, *, geom: str = f'{SPHERE} contype="0" conaffinity="0"', **parts: str) -> str:
    body = BODY.format(joint=joint, geom=geom, more=parts.get("more", ""))
    return f"""<mujoco><compiler angle="radian"/>{parts.get("before", "")}<option timestep=".01" gravity="0 0 0"/>
    <worldbody>{parts.get("world", "")}{body}</worldbody>{parts.get("after", "")}<actuator>{actuators}</actuator>
    {parts.get("end", "")}</mujoco>"""


def made(folder: Path, xml: str, goal: list[float], engine: str = "native") -> Task:
    file = folder / "model.xml"
    file.write_text(xml)

    class Mine(Task):
        xml = file
        goal_state = np.array(goal, float)

        def observe(self, s):
            return jnp.concatenate([s.qpos, s.qvel])

        def distance(self, s):
            return jnp.linalg.norm(s.qpos - jnp.asarray(goal))

        def is_goal(self, s):
            return self.distance(s) < 0.05

        def is_feasible(self, s):
            return jnp.bool_(True)

        def sample_feasible(self, key, num):
            return StartSet.at_rest(jnp.broadcast_to(jnp.asarray(goal, jnp.float32), (num, len(goal))), self.model.nv)

    task = build_task(Mine, engine)
    check_task(task)
    return task


PID = model(
    'type="slide" axis="1 0 0" range="-1 1"',
    '<plugin name="pid" joint="x" plugin="mujoco.pid" instance="pid" ctrlrange="-1 1"/>',
    before='<extension><plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="4"/>'
    "</instance></plugin></extension>",
)
WALL = '<geom name="wall" type="box" size=".1 .1 .1" pos=".6 0 0"/>'
MOTOR = '<motor joint="x" ctrlrange="-1 1"/>'
SLIDE = 'type="slide" axis="1 0 0" damping="1" range="-1 1" limited="true"'
TENDON = '<tendon><fixed name="pull" range="-.1 .1" limited="true"><joint joint="x" coef="1"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("xml", "goal", "engine", "says"),
    [
        (PID, [0.5], "native", "actuator pid is a plugin: the class has to give its neutral_action"),
        (PID, [0.5], "mjx", "no plugin of actuator pid"),
        (model(SLIDE, MOTOR, geom=SPHERE, world=WALL), [0.55], "native", "geom ball and geom wall overlap by 0.1 m"),
        (model(SLIDE, MOTOR, after=TENDON), [0.4], "native", "tendon pull at 0.4: must be in its range, -0.1 to 0.1"),
        (
            model('type="ball" range="0 .5" limited="true"', '<motor joint="x" gear="1 0 0" ctrlrange="-1 1"/>'),
            [np.cos(0.6), np.sin(0.6), 0, 0],
            "native",
            "joint x turned by 1.2: must be in its range, 0 to 0.5",
        ),
    ],
    ids=["plugin", "plugin-mjx", "penetration", "tendon", "ball"],
)
def test_refused_with_the_cause(tmp_path: Path, xml: str, goal: list[float], engine: str, says: str) -> None:
    with pytest.raises(ContractError, match=says):
        made(tmp_path, xml, goal, engine)


def test_servos_on_spatial_tendons_stay_where_they_are(tmp_path: Path) -> None:
    task = made(
        tmp_path,
        model(
            'type="hinge" axis="0 1 0" damping="1" range="-1.5 1.5" limited="true"',
            '<position tendon="sp" kp="300" kv="10" ctrlrange="0 2"/>',
            geom='type="capsule" fromto="0 0 0 .6 0 0" size=".03" mass="1" contype="0" conaffinity="0"',
            more='<site name="tip" pos=".6 0 0"/>',
            world='<site name="anchor" pos="1 0 .5"/>',
            after='<tendon><spatial name="sp"><site site="anchor"/><site site="tip"/></spatial></tendon>',
        ),
        [0.9],
    )
    starts = StartSet.at_rest(jnp.array([[0.9], [-0.9], [0.2]]), 1)
    assert float(settle(task, starts, 200)[1].max()) < 1e-4
    one_by_one = [task.neutral_action(q[None])[0] for q in starts.qpos]
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda q: task.neutral_action(q[None])[0]))(starts.qpos), one_by_one)


@pytest.mark.parametrize("goal", [[2, -1, 3, 1, 0, 0, 0], [0, 0, 1, -1, 0, 0, 0]])
def test_a_keyframe_holds_its_pose_wherever_the_body_is(tmp_path: Path, goal: list[float]) -> None:
    thrust = "".join(f'<motor site="m{k}" gear="0 0 1 0 0 0" ctrlrange="0 6"/>' for k in range(4))
    corners = enumerate(["1 1", "1 -1", "-1 1", "-1 -1"])
    sites = "".join(f'<site name="m{k}" pos="{corner} 0"/>' for k, corner in corners)
    key = '<keyframe><key qpos="0 0 1 1 0 0 0" ctrl="2.4525 2.4525 2.4525 2.4525"/></keyframe>'
    xml = model('type="free"', thrust, more=sites, end=key).replace('gravity="0 0 0"', "")
    task = made(tmp_path, xml, goal)
    drift = settle(task, StartSet.at_rest(jnp.asarray([goal], jnp.float32), 6), 100)[1]
    assert float(drift[0]) < 1e-4


class Lost(Line):
    """The distance leaves its domain beyond x = 2, and the goal is whatever is not far from it."""

    def distance(self, s):
        return jnp.where(s.qpos[0] > 2.0, jnp.nan, jnp.abs(s.qpos[0]))

    def is_goal(self, s):
        return ~(self.distance(s) > 0.1)


def test_a_distance_that_is_not_finite_is_no_success() -> None:
    task = Lost(gain=0.3)
    starts = make_starts([[x, 0, 0] for x in [1.5, 2.5]])
    sampler = Sampler(task, lambda obs, noise: jnp.full_like(noise, 1.0))
    key = jax.random.key(0)
    batch = rollout(sampler, key, begin(task, key, starts, 8), starts, length=20, remaining=jnp.int32(1000))[1]
    ended = batch.done & batch.counted
    assert bool(ended.any())
    assert bool(batch.bad[ended].all())
    assert not bool(batch.success.any())


def test_a_task_can_be_made_inside_a_jit() -> None:
    assert jax.jit(lambda x: x + make_task("point_maze", engine="native").obs_dim)(1.0) == 5.0


def test_memory_of_a_container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "max").write_text("1000\n")
    (tmp_path / "current").write_text("400\n")
    (tmp_path / "stat").write_text("anon 250\ninactive_file 150\n")
    real = memory.Path
    names = {f"/sys/fs/cgroup/memory.{name}": tmp_path / name for name in ("max", "current", "stat")}
    monkeypatch.setattr(memory, "Path", lambda name: real(names.get(name, name)))
    assert memory.free_memory() == 750
    (tmp_path / "max").write_text("max\n")
    assert (memory.free_memory() or 0) > 750
