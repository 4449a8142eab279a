"""Every breach of a task's contract is refused in one sentence that says where, what and which value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax.io.starts_file import encode_starts
from rcg_jax.tasks import TASKS, Task, make_task
from rcg_jax.tasks.check import ContractError, build_task, check_task
from rcg_jax.types import StartSet
from tests import tiny_run


def variant(folder: Path, xml: tuple[str, str] | None = None, **attributes: Any) -> type[Task]:
    """The tiny task with something changed; its model is written into ``folder``."""
    text = tiny_run.XML if xml is None else tiny_run.XML.replace(*xml)
    assert xml is None or text != tiny_run.XML
    (folder / "tiny.xml").write_text(text)
    return type("Variant", (tiny_run.Tiny,), {"__module__": __name__, "xml": folder / "tiny.xml", **attributes})


def breach(cls: type[Task], engine: str = "native", *, starts: bool = False) -> str:
    """What is said about a class."""
    with pytest.raises(ContractError) as error:
        check_task(build_task(cls, engine), starts=starts)
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(f"task={Path('tests/unit/test_contract.py')}:Variant: ") or starts
    return message.partition(":Variant: ")[2] or message


@pytest.mark.parametrize("name", TASKS)
def test_the_registered_tasks_pass(name: str) -> None:
    check_task(make_task(name, "native"))


def points(self: Task, s: Any) -> Any:
    return s.site_xpos


def branches(self: Task, s: Any) -> Any:
    return True if s.qpos[0] > 0 else False  # Python's if, which cannot be traced  # noqa: SIM210


def drawn(num: int) -> StartSet:
    return StartSet.at_rest(jnp.zeros((num, 2)), 2)


BREACHES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "horizon zero": ({"horizon": 0}, ["horizon = 0", ">= 1"]),
    "settling for less than nothing": ({"settle_steps": -1}, ["settle_steps = -1", "integer >= 0"]),
    "horizon of another type": ({"horizon": 50.0}, ["horizon = 50.0", "integer"]),
    "goal state too short": ({"goal_state": np.zeros(1)}, ["goal_state", "(1,)", "(2,)", "joints x, y"]),
    "goal state not a number": ({"goal_state": np.array([np.nan, 0])}, ["goal_state", "nan", "finite"]),
    "goal state fails": ({"goal_state": property(lambda self: self.nothing)}, ["goal_state", "nothing"]),
    "goal state beyond a limit": (
        {"xml_change": ('name="y" type="slide"', 'name="y" type="slide" range="-1 0.3"'), "goal_state": [0.2, 0.4]},
        ["goal_state has joint y at 0.4", "in its range, -1 to 0.3"],
    ),
    "goal state outside the goal set": (
        {"goal_state": np.array([0.5, 0.0])},
        ["is_goal is False at goal_state", "distance is 0.3"],
    ),
    "goal state not feasible": ({"is_feasible": lambda self, s: self.distance(s) > 1}, ["is_feasible is False"]),
    "goal state a failure": ({"is_failure": lambda self, s: self.is_goal(s)}, ["is_failure is True at goal_state"]),
    "observation of two axes": ({"observe": points}, ["observe", "(2, 3)", "(obs_dim,)"]),
    "observation a list": ({"observe": lambda self, s: [s.qpos]}, ["observe", "a list"]),
    "observation fails": ({"observe": lambda self, s: s.qpoz}, ["observe", "test_contract.py, line", "qpoz"]),
    "observation of other parts": ({"observation": [("position", 3, "m")]}, ["observation", "3 numbers", "returns 4"]),
    "observation without sizes": ({"observation": [("position", "m")]}, ["observation", "(name, size, unit, source)"]),
    "distance nan": ({"distance": lambda self, s: jnp.sqrt(s.qpos[0] - 1)}, ["distance is nan", "finite"]),
    "distance negative": ({"distance": lambda self, s: -jnp.abs(s.qpos[0])}, ["distance is -0.2", ">= 0"]),
    "truth as a number": ({"is_goal": lambda self, s: 1.0}, ["is_goal", "float", "bool"]),
    "a Python branch": ({"is_failure": branches}, ["is_failure fails", "test_contract.py, line", "Bool"]),
    "no composition": ({"composition": lambda self, s: None}, ["composition", "dict"]),
    "grid of other rows": ({"grid_coordinates": lambda self, q: q[:1]}, ["grid_coordinates", "(1, 2)", "(C, d)"]),
    "grid fails": (
        {"grid_coordinates": lambda self, q: q + self.nothing},
        ["grid_coordinates fails (test_contract.py, line", "nothing"],
    ),
    "grid fails on NumPy": (
        {"grid_coordinates": lambda self, q: q.at[:, 0].set(0)},
        ["grid_coordinates of NumPy's arrays fails (test_contract.py, line", "'at'"],
    ),
    "grid infinite": ({"grid_coordinates": lambda self, q: jnp.log(0 * q)}, ["grid_coordinates is -inf", "finite"]),
    "search none": ({"search": None}, ["search is a NoneType", "dict of settings"]),
    "search out of range": ({"search": {"grid": -1}}, ["search: grid=-1: must be a number > 0"]),
    "sampler of an array": (
        {"sample_feasible": lambda self, key, num: jnp.zeros((num, 2))},
        ["sample_feasible returns shape (257, 2), type float32", "StartSet"],
    ),
    "sampler of another width": (
        {"sample_feasible": lambda self, key, num: StartSet.at_rest(jnp.zeros((num, 3)), 2)},
        ["sample_feasible(key, 257) returns qpos of shape (257, 3)", "must be of shape (257, 2), type float32"],
    ),
    "sampler of numbers for truth": (
        {"sample_feasible": lambda self, key, num: drawn(num).replace(valid=jnp.ones(num))},
        ["returns valid of shape (257,), type float32", "must be of shape (257,), type bool"],
    ),
    "sampler of few that are valid": (
        {"sample_feasible": lambda self, key, num: drawn(num).replace(valid=jnp.arange(num) < 5)},
        ["sample_feasible marks 251 of 256 starts as not valid"],
    ),
    "sampler fails": (
        {"sample_feasible": lambda self, key, num: self.nothing},
        ["sample_feasible fails (test_contract.py, line", "nothing"],
    ),
    "sampler outside of the region": (
        {"sample_feasible": lambda self, key, num: StartSet.at_rest(jnp.full((num, 2), 3.0), 2)},
        ["refuses 256 of 256 starts of its own sample_feasible"],
    ),
}


@pytest.mark.parametrize("case", BREACHES)
def test_a_breach_is_named(tmp_path: Path, case: str) -> None:
    attributes, parts = BREACHES[case]
    attributes = dict(attributes)
    message = breach(variant(tmp_path, attributes.pop("xml_change", None), **attributes))
    for part in parts:
        assert part in message, message


def test_a_goal_state_has_to_settle(tmp_path: Path) -> None:
    """On a slope of 1 m/s^2 along x the ball leaves the region of 0.6 m after about a second and a bit."""
    slope = ('gravity="0 0 0"', 'gravity="1 0 0"')
    check_task(build_task(variant(tmp_path, slope), "native"), starts=False)
    check_task(build_task(variant(tmp_path, settle_steps=200), "native"), starts=False)
    message = breach(variant(tmp_path, slope, settle_steps=200))
    # friction of 3 N s/m on 1 kg: x = g / 9 (3 t - 1 + exp(-3 t)) reaches 0.6 m at 2.13 s
    steps = int(message.split("goal_state stays feasible for ")[1].split()[0])
    assert abs(steps * 0.02 - 2.13) < 0.1
    assert "settle_steps = 200" in message
    check_task(build_task(variant(tmp_path, slope, settle_steps=steps), "native"), starts=False)


def test_integers_of_numpy_are_integers(tmp_path: Path) -> None:
    check_task(build_task(variant(tmp_path, horizon=np.int64(50)), "native"), starts=False)


def test_a_goal_state_may_rest_on_a_limit(tmp_path: Path) -> None:
    """As far beyond it as starts may be, by default 0.01."""
    change = ('name="x" type="slide"', 'name="x" type="slide" range="-1 0.195"')
    check_task(build_task(variant(tmp_path, change), "native"), starts=False)
    assert "joint x at 0.2" in breach(variant(tmp_path, change, search={"max_excess": 0.001}))


def test_a_sampler_replaces_a_file_of_another_version(tmp_path: Path) -> None:
    (tmp_path / "old.npz").write_bytes(encode_starts(np.full((50, 2), 2.0)))
    cls = variant(tmp_path, feasible_file=tmp_path / "old.npz", sample_feasible=lambda self, key, num: drawn(num))
    check_task(build_task(cls, "native"), starts=False)
    assert "50 of 50 starts of" in breach(cls, starts=True)
    (tmp_path / "old.npz").unlink()
    check_task(build_task(cls, "native"))


@pytest.mark.parametrize(("error", "engine"), [(RuntimeError, "native"), (NotImplementedError, "mjx")])
def test_a_model_that_cannot_be_made_is_placed(tmp_path: Path, error: type[Exception], engine: str) -> None:
    def make_model(self: Task) -> Any:
        raise error("no mesh")

    message = breach(variant(tmp_path, make_model=make_model), engine)
    assert message.startswith("cannot be built (test_contract.py, line ")
    assert message.endswith(f"{error.__name__}: no mesh")


MODELS: dict[str, tuple[tuple[str, str], list[str]]] = {
    "unlimited motor": (('joint="y" ctrlrange="-4 4"', 'name="pull" joint="y"'), ["actuator pull", "ctrlrange"]),
    "no motor": (
        ('<motor joint="x" ctrlrange="-4 4"/><motor joint="y" ctrlrange="-4 4"/>', ""),
        ["without actuators"],
    ),
    "two controls": (
        ('<motor joint="y" ctrlrange="-4 4"/>', '<pid name="pid" joint="y" kp="4" ki="2" ctrlrange="-1 1"/>'),
        ["actuator pid has 2 controls"],
    ),
    "a motor's delay": (
        ('<motor joint="y" ctrlrange="-4 4"/>', '<motor joint="y" ctrlrange="-4 4" delay="0.04" nsample="3"/>'),
        ["actuator number 1", "history"],
    ),
    "not XML": (("</mujoco>", ""), ["cannot be built", "XML"]),
    "an unstable model": (('timestep="0.02"', 'timestep="1e9"'), ["does not survive one step", "qvel"]),
}


@pytest.mark.parametrize("case", MODELS)
def test_a_model_that_cannot_be_trained_is_named(tmp_path: Path, case: str) -> None:
    change, parts = MODELS[case]
    attributes = {"goal_state": np.array([1e9, 0.0]), "is_goal": lambda self, s: True} if "unstable" in case else {}
    if "unstable" in case:  # a stiff spring, far from rest
        change = ('damping="3"/>\n      <joint name="y"', 'stiffness="1e9"/>\n      <joint name="y"')
    message = breach(variant(tmp_path, change, **attributes))
    for part in parts:
        assert part in message, message


def test_a_quaternion_that_is_none(tmp_path: Path) -> None:
    free = ('<joint name="x" type="slide" axis="1 0 0" damping="3"/>', '<joint name="x" type="ball"/>')
    cls = variant(tmp_path, free, goal_state=np.array([0.5, 0, 0, 0, 0.0]))
    assert "quaternion of length 0.5 at [0:4] (joint x)" in breach(cls)


def test_a_missing_model_file(tmp_path: Path) -> None:
    cls = type("Variant", (tiny_run.Tiny,), {"__module__": __name__, "xml": tmp_path / "none.xml"})
    assert breach(cls) == f"xml: no such file: {tmp_path / 'none.xml'}"


def test_a_site_that_the_model_lacks(tmp_path: Path) -> None:
    message = breach(variant(tmp_path, ('name="centre" ', "")))
    assert "cannot be built" in message
    assert "centre" in message


def test_geoms_that_mjx_cannot_collide_are_named(tmp_path: Path) -> None:
    change = (
        '<site name="centre" size="0.01"/>',
        '<site name="centre" size="0.01"/><geom name="can" type="cylinder" size=".05 .05"/></body>'
        '<body pos="1 0 0"><freejoint/><geom name="crate" type="box" size=".1 .1 .1"/>',
    )
    message = breach(variant(tmp_path, change, goal_state=np.array([0.2, 0, 1, 0, 0, 1, 0, 0, 0])), "mjx")
    for part in ("engine=mjx", "cylinder can of body ball", "box crate", "engine=native can"):
        assert part in message, message


class TestStarts:
    def task(self, folder: Path, qpos: np.ndarray, **attributes: Any) -> type[Task]:
        (folder / "starts.npz").write_bytes(encode_starts(qpos))
        return variant(folder, feasible_file=folder / "starts.npz", **attributes)

    def test_missing_ones_come_with_the_command_that_makes_them(self, tmp_path: Path) -> None:
        message = breach(variant(tmp_path), starts=True)
        assert (
            "no feasible starts; make them with python -m rcg_jax.feasible task=tests/unit/test_contract.py" in message
        )

    def test_those_of_another_version_are_refused(self, tmp_path: Path) -> None:
        starts = np.zeros((100, 2))
        check_task(build_task(self.task(tmp_path, starts), "native"))
        starts[:30, 0] = 2.0
        message = breach(self.task(tmp_path, starts), starts=True)
        assert "30 of 100 starts" in message
        assert "overwrite=true" in message

    def test_an_observation_that_is_not_finite_at_one_is_found(self, tmp_path: Path) -> None:
        starts = np.full((5, 2), 0.25)
        starts[3, 1] = 0.0
        cls = self.task(tmp_path, starts, observe=lambda self, s: jnp.log(jnp.abs(s.qpos + jnp.array([1, 0.0]))),
                        goal_state=np.array([0.2, 0.01]))  # fmt: skip
        assert "observe is -inf (entry 1) at the feasible start [0.25, 0.0]" in breach(cls, starts=True)
