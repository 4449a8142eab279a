"""Tasks from a model alone: what is not given has a default, and what is wrong is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import ReverseCurriculum, task_from_mujoco
from rcg_jax.config.settings import ConfigError
from rcg_jax.gymnasium import make_vec
from rcg_jax.tasks import make_task
from rcg_jax.tasks.check import check_task

#: A slide with a position servo and a hinge with a motor; the tip is 0.3 m from the hinge.
XML = """
<mujoco model="reach">
  <worldbody>
    <site name="fixed" pos="1 0 0"/>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1" damping="1"/>
      <geom size="0.05" mass="1"/>
      <body name="pole">
        <joint name="turn" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.01" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="x" kp="20"/>
    <motor joint="turn" ctrlrange="-1 1"/>
  </actuator>
  <keyframe><key name="goal" qpos="0.2 0"/><key name="turned" qpos="0 1.5707963"/></keyframe>
</mujoco>
"""


@pytest.fixture(params=["file", "spec", "model"])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    if request.param == "file":
        (tmp_path / "reach.xml").write_text(XML)
        return tmp_path / "reach.xml"
    return mujoco.MjSpec.from_string(XML) if request.param == "spec" else mujoco.MjModel.from_xml_string(XML)


def test_defaults(model: Any) -> None:
    cls = task_from_mujoco(model, point="tip")
    task = cls("native")
    assert (cls.__name__, task.name, task.point_name) == ("reach", "reach", "tip")
    check_task(task, starts=False)
    np.testing.assert_allclose(task.goal_state, [0.2, 0.0])
    state = task.reset(task.goal_starts())
    s = jax.tree.map(lambda x: x[0], task.snapshot(state))
    np.testing.assert_allclose(task.distance(s), 0.0, atol=1e-6)
    np.testing.assert_allclose(task.point(s), [0.2, 0.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(task.observe(s), [0.2, 0, 0, 0, 0.2, 0, 0.3], atol=1e-6)  # the fixed site is left out
    assert [part.name for part in task.observation_parts()] == ["positions", "velocities", "tip"]
    for x, near in ((0.22, True), (0.24, False)):
        moved = task.reset(task.goal_starts()).replace(qpos=jnp.array([[x, 0.0]]))
        assert bool(task.is_goal(jax.tree.map(lambda x: x[0], task.snapshot(moved)))) is near


def test_what_is_given_counts() -> None:
    cls = task_from_mujoco(
        mujoco.MjSpec.from_string(XML),
        point="pole",
        goal_state="turned",
        observe=lambda s: s.qpos,
        is_goal=lambda s: s.qpos[1] > 1.0,
        feasible_radius=0.5,
        training={"policy.action_repeat": 5},
        name="turn",
    )
    task = cls("native")
    assert task.obs_dim == 2
    assert make_vec(task, 2, starts=task.goal_starts()).action_repeat == 5
    far = task.reset(task.goal_starts()).replace(qpos=jnp.array([[0.6, 1.2]]))
    s = jax.tree.map(lambda x: x[0], task.snapshot(far))
    assert bool(task.is_goal(s))
    assert not bool(task.is_feasible(s))


@pytest.mark.slow
def test_a_curriculum_grows_on_it() -> None:
    task = task_from_mujoco(mujoco.MjSpec.from_string(XML), point="tip", feasible_radius=1.0)("native")
    curriculum = ReverseCurriculum(task, settings=["curriculum.num_new=20", "curriculum.num_candidates=200"])
    for _ in range(3):
        starts = curriculum.propose(200)
        curriculum.report(starts, np.random.default_rng(0).random(200) < 0.5)
    assert curriculum.iteration == 3
    assert np.abs(curriculum.propose(50).qpos - task.goal_state).max() > 0.05


def test_in_a_file_it_is_a_task_of_every_command(tmp_path: Path) -> None:
    (tmp_path / "reach.xml").write_text(XML)
    (tmp_path / "mine.py").write_text(
        "import rcg_jax\nReach, Other = (rcg_jax.task_from_mujoco('reach.xml', point=p) for p in ('tip', 'pole'))\n"
    )
    task = make_task(f"{tmp_path}/mine.py:Reach", "native")
    assert task.feasible_file == tmp_path / "mine.Reach.npz"
    other = make_task(f"{tmp_path}/mine.py:Other", "native")  # of the same model
    assert other.feasible_file == tmp_path / "mine.Other.npz"
    assert task.spelled().endswith("mine.py:Reach")
    assert task.action_dim == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"point": "top"}, r"point=top: must be a site or body; it has fixed, tip, cart, pole"),
        ({"point": "fixed"}, r"point=fixed: does not move; those that do are tip, cart, pole"),
        ({"goal_radius": "0.01"}, r"goal_radius='0.01': must be a finite number > 0"),
        ({"goal_state": [1.0, np.nan]}, r"goal_state: must be 2 finite positions, not \[1.0, nan\]"),
        ({"goal_state": "there"}, r"goal_state=there: must be positions or a keyframe; it has goal, turned"),
        ({"goal_state": [1.0]}, r"goal_state: must be 2 finite positions"),
        ({"goal_radius": 0.0}, r"goal_radius=0.0: must be a finite number > 0"),
        ({"sites": ["top"]}, r"sites: no site top; it has fixed, tip"),
        ({"model": "no.xml"}, r"no such file: .*no.xml"),
    ],
)
def test_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        task_from_mujoco(**{"model": mujoco.MjSpec.from_string(XML), "point": "tip", **settings})
