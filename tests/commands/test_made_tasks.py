"""``task=`` with a model's file, an environment of Gymnasium or one of Playground: what is made, what is refused."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax import feasible, make_task, task_from_gymnasium, task_from_playground
from rcg_jax.cli import sweep
from rcg_jax.config import class_path
from rcg_jax.config import compose as cli
from rcg_jax.config.class_path import class_name, resolve_name
from rcg_jax.config.settings import ConfigError
from rcg_jax.runs.folder import RunFolder
from rcg_jax.tasks import from_gymnasium, from_playground, task_class
from rcg_jax.tasks.check import check_task
from rcg_jax.types import StartSet

XML = """
<mujoco model="other name">
  <worldbody>
    <site name="fixed" pos="1 0 0"/>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1" damping="1"/>
      <geom size="0.05" mass="1"/>
      <site name="robot0:tip" pos="0 0 0.3"/>
    </body>
  </worldbody>
  <actuator><position joint="x" kp="20"/></actuator>
  <keyframe><key name="goal" qpos="0.2"/><key name="home"/></keyframe>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a model ``peg.xml``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "peg.xml").write_text(XML)
    return tmp_path


class TestModels:
    def test_names(self, folder: Path) -> None:
        config = cli.compose_config(["task=peg.xml:robot0:tip@home"])
        assert config.task == f"{folder}/peg.xml:robot0:tip@home"
        assert RunFolder(config, 0).path == Path("runs/peg.robot0-tip.home/reverse/seed0")
        assert class_name(cli.compose_config(["task=peg.xml"]).task) == "peg"
        (folder / "a").mkdir()
        (folder / "a" / "peg.xml").write_text(XML)
        with pytest.raises(ConfigError, match=r"2 members of this sweep would write to runs/peg/reverse/seed0"):
            sweep.check(["task=peg.xml,a/peg.xml"])

    def test_the_only_site_that_moves_has_to_come_where_the_keyframe_goal_has_it(self, folder: Path) -> None:
        task = make_task("peg.xml", "native")
        check_task(task, starts=False)
        assert (task.name, task.point_name, task.feasible_file) == ("peg", "robot0:tip", folder / "peg.npz")
        np.testing.assert_allclose(task.goal_state, [0.2])
        assert task_class(f"{folder}/peg.xml") is type(task)

    def test_what_is_named_counts(self, folder: Path) -> None:
        task = make_task("peg.xml:cart@home", "native")
        assert (task.point_name, task.feasible_file) == ("cart", folder / "peg.cart.home.npz")
        np.testing.assert_allclose(task.goal_state, [0.0])

    def test_its_starts_lie_beside_it(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(FileNotFoundError, match=rf"rcg_jax.feasible task={folder}/peg.xml"):
            make_task("peg.xml", "native").feasible_starts()
        assert feasible.main(["task=peg.xml", "num_states=5", "max_rounds=2", "num_walks=8", "walk_length=200"]) == 0
        assert len(make_task("peg.xml", "native").feasible_starts().qpos) == 5

    @pytest.mark.parametrize(
        ("name", "change", "says"),
        [
            ("none.xml", ("", ""), "no such file"),
            ("peg.xml", ("</mujoco>", ""), "cannot be read"),
            ("peg.xml", ("mujoco", "robot"), "its root is <robot>, must be <mujoco>"),
            ("peg.xml", ("slide", "slid"), "slid"),
            ("peg.xml", ("</body>", '<site name="b"/></body>'), "robot0:tip, b, its bodies cart"),
            (
                "peg.xml",
                ('name="goal"', 'name="done"'),
                "no keyframe goal, .* it has done, home; write peg.xml:",
            ),
            ("peg.xml@there", ("", ""), "it has no keyframe there"),
            ("peg.xml:top", ("", ""), "point=top: must be a site or body; it has fixed, robot0:tip, cart"),
        ],
    )
    def test_refused(self, folder: Path, name: str, change: tuple[str, str], says: str) -> None:
        (folder / "peg.xml").write_text(XML.replace(*change))
        with pytest.raises(ConfigError, match=says) as error:
            task_class(name)
        assert str(error.value).startswith("task=")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["gymnasium:Reacher-v5", "playground:PointMass"])
def test_what_is_not_installed_is_refused_with_the_line_that_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (class_path, from_gymnasium, from_playground):
        monkeypatch.setattr(module, "find_spec", lambda module: None)
    whose, environment = name.split(":")
    make = {"gymnasium": task_from_gymnasium, "playground": task_from_playground}[whose]
    for refused in (lambda: resolve_name("task", name), lambda: make(environment)):
        with pytest.raises(ConfigError, match=rf'is not installed: pip install "rcg_jax\[{whose}\]"'):
            refused()


class TestGymnasium:
    @pytest.fixture(autouse=True)
    def gymnasium(self) -> Any:
        return pytest.importorskip("gymnasium")

    @pytest.mark.parametrize("name", [f"{name}-v5" for name in from_gymnasium.DEFAULTS])
    def test_it_moves_as_the_environment_does(self, gymnasium: Any, name: str) -> None:
        task = make_task(f"gymnasium:{name}", "native")
        check_task(task, starts=False)
        s = jax.tree.map(lambda x: x[0], task.snapshot(task.reset(task.goal_starts())))
        assert float(task.distance(s)) < 0.06
        env = gymnasium.make(name)
        held, longest = task.training["policy.action_repeat"], gymnasium.spec(name).max_episode_steps
        assert (held, task.horizon) == (env.unwrapped.frame_skip, longest * held)
        env.reset(seed=0)
        qpos, qvel = env.unwrapped.data.qpos.copy(), env.unwrapped.data.qvel.copy()
        action = np.random.default_rng(0).uniform(-1, 1, task.action_dim).astype(np.float32)
        start = StartSet.at_rest(jnp.asarray(qpos, jnp.float32)[None], task.model.nv)
        state = task.reset(start.replace(qvel=jnp.asarray(qvel, jnp.float32)[None]))
        state = task.steps(state, jnp.asarray(action)[None], held)
        env.step(action * env.action_space.high)
        np.testing.assert_allclose(state.qpos[0, -1], env.unwrapped.data.qpos, atol=2e-5)

    def test_what_is_given_counts(self) -> None:
        cls = task_from_gymnasium("Reacher-v5", goal_state=[0, 0, 0.21, 0], horizon=60, training={"trpo.max_kl": 0.02})
        task = cls("native")
        check_task(task, starts=False)
        assert cls.source() == Path(__file__).resolve()
        assert task.training == {"policy.action_repeat": 2, "trpo.max_kl": 0.02}
        assert task.horizon == 60

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            (
                "Ant-v5",
                r"what has to come where .* point=\.\.\., goal_state=\.\.\.\) .* torso, .* is 15 pos",
            ),
            ("Recher-v5", "no such environment; did you mean Reacher-v5"),
            ("CartPole-v1", "must be a MuJoCo environment"),
            ("Odd-v0", r"its actions, of shape \(3,\), are not the controls of its model, which has 2 actuators"),
            ("Broken-v0", "gymnasium.make fails: ValueError: no display"),
        ],
    )
    def test_refused(self, gymnasium: Any, name: str, says: str) -> None:
        def odd() -> Any:
            env = gymnasium.make("Reacher-v5").unwrapped
            env.action_space = gymnasium.spaces.Box(-1, 1, (3,))
            return env

        def broken() -> Any:
            raise ValueError("no display")

        gymnasium.register("Odd-v0", odd, disable_env_checker=True, order_enforce=False)
        gymnasium.register("Broken-v0", broken)
        try:
            with pytest.raises(ConfigError, match=says):
                task_class(f"gymnasium:{name}")
        finally:
            del gymnasium.registry["Odd-v0"], gymnasium.registry["Broken-v0"]


class TestPlayground:
    ARM = """
    <mujoco><worldbody>
      <body name="arm"><joint name="shoulder" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .12 0 0" size=".01"/>
        <body name="hand" pos=".12 0 0"><joint name="wrist" axis="0 0 1"/><geom size=".01"/>
          <body name="finger" pos=".12 0 0"><geom size=".01"/></body></body></body>
      <body name="target" mocap="true"><geom contype="0" conaffinity="0" size=".05"/></body>
    </worldbody><actuator><motor joint="shoulder" ctrlrange="-1 1"/><motor joint="wrist" ctrlrange="-1 1"/></actuator>
    </mujoco>"""

    @pytest.fixture
    def package(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A package of that name, which must not be imported."""
        xmls = tmp_path / "mujoco_playground" / "_src" / "dm_control_suite" / "xmls"
        xmls.mkdir(parents=True)
        (tmp_path / "mujoco_playground" / "__init__.py").write_text("raise RuntimeError('imported')")
        for name in ("reacher", "walker"):
            (xmls / f"{name}.xml").write_text(self.ARM)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "mujoco_playground", raising=False)
        monkeypatch.chdir(tmp_path)
        importlib.invalidate_caches()
        return xmls

    def test_the_target_is_where_the_goal_state_has_the_point(self, package: Path) -> None:
        task = task_from_playground("ReacherHard")("native")
        check_task(task, starts=False)
        place = 0.12 * np.array([np.cos(1) + np.cos(2), np.sin(1) + np.sin(2), 0])
        np.testing.assert_allclose(task.model.body("target").pos, place, atol=1e-12)
        assert not task.model.nmocap
        assert task.training == {"policy.action_repeat": 4}
        named = task_class("playground:ReacherHard")
        assert named.spelled() == "playground:ReacherHard"
        assert named.feasible_file == Path.cwd() / "playground.ReacherHard.npz"

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            ("PandaPickCube", "must be one of AcrobotSwingup, .* downloaded by Playground"),
            ("Reacher", "did you mean Reacher"),
            ("WalkerStand", "has no goal state .* bodies arm, hand, finger; goal_state is 2 positions"),
            ("PointMass", "no such file: .*point_mass.xml"),
        ],
    )
    def test_refused_without_importing_it(self, package: Path, name: str, says: str) -> None:
        with pytest.raises(ConfigError, match=says):
            task_class(f"playground:{name}")

    @pytest.mark.parametrize("name", from_playground.DEFAULTS)
    def test_the_goal_state_of_its_models_is_in_the_goal_set(self, name: str) -> None:
        if find_spec("mujoco_playground") is None:
            pytest.skip("playground is not installed")
        task = make_task(f"playground:{name}", "native")
        check_task(task, starts=False)
        s = jax.tree.map(lambda x: x[0], task.snapshot(task.reset(task.goal_starts())))
        assert float(task.distance(s)) < 0.02 + 1e-6
