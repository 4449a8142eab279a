"""Success in a changed world: perturbed models, late actions, noisy observations."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import Array
from scipy.stats import norm

from rcg_jax.config.settings import ConfigError
from rcg_jax.evaluate import perturb
from rcg_jax.evaluate.perturb import Condition, conditions, evaluate_perturbed, perturbed_model
from rcg_jax.physics.engine import reset
from rcg_jax.physics.native import NativeEngine
from rcg_jax.rl.episodes import Disturbance, Episodes, run_episodes
from rcg_jax.rl.policy import ObsNormalizer
from rcg_jax.runs.load import load_run
from rcg_jax.tasks import make_task
from tests.analytic import Line, make_starts


class Seen:
    """A policy whose action is ``gain`` times the first thing that it sees, plus ``push``; it is never uncertain."""

    action_repeat = 1

    def __init__(self, gain: float = 0.0, push: float = 0.0) -> None:
        self.gain, self.push = gain, push

    def __call__(self, params: Any, seen: Array) -> Any:
        mean = self.gain * seen[:, :1] + self.push
        return SimpleNamespace(mean=mean, sample=lambda noise: mean)


def episodes(task: Line, policy: Seen, x: np.ndarray, noise: Any, delay: Any) -> Episodes:
    n = len(x)
    starts = make_starts(np.stack([x, 0 * x, 0 * x], axis=1))
    disturbance = Disturbance(
        jax.random.key(1), jnp.broadcast_to(jnp.float32(noise), n), jnp.broadcast_to(jnp.int32(delay), n), longest=3
    )
    actor: Any = SimpleNamespace(policy=None, norm=ObsNormalizer.init(2))
    return run_episodes(task, policy, actor, jax.random.key(0), starts, disturbance=disturbance)  # type: ignore[arg-type]


def test_late_actions_come_so_many_decisions_late() -> None:
    # 4 steps of 0.05 from -0.22 into |x| < 0.05; meanwhile the neutral action, 0.
    delay = np.array([0, 1, 3])
    out = episodes(Line(horizon=6), Seen(push=1.0), np.full(3, -0.22), 0.0, delay)
    np.testing.assert_array_equal(out.success, [True, True, False])
    np.testing.assert_array_equal(out.length, [4, 5, 6])


def test_noise_is_in_what_the_policy_sees() -> None:
    # One action a = -0.06 + sigma * N has to be above 0.2.
    n, sigma = 20_000, np.repeat([0.26, 0.13, 0.0], 20_000)
    out = episodes(Line(horizon=1), Seen(gain=1.0), np.full(3 * n, -0.06), sigma, 0)
    rates = np.asarray(out.success).reshape(3, n).mean(axis=1)
    wanted = norm.sf([1.0, 2.0, np.inf])
    np.testing.assert_allclose(rates, wanted, atol=4 * 0.5 / np.sqrt(n))


@pytest.mark.parametrize(
    ("task", "name"),
    [("ring_peg", "mass"), ("ring_peg", "damping"), ("ring_peg", "motor"), ("ant_maze", "friction")],
)
def test_simulations_have_the_physics_of_their_own_variant(task: str, name: str) -> None:
    built = make_task(task, "native")
    model, levels = built.model, (1.0, 0.5, 1.5)
    fields = ("body_mass", "geom_friction", "dof_damping", "actuator_gainprm")
    before = [np.array(getattr(model, field)) for field in fields]
    variants = [perturbed_model(model, Condition(name, level)) for level in levels]
    for field, value in zip(fields, before, strict=True):
        np.testing.assert_array_equal(getattr(model, field), value)
    rng = np.random.default_rng(0)
    qpos = np.repeat(np.asarray(built.feasible_starts().qpos)[:2], 3, axis=0)
    ctrl = np.repeat(rng.uniform(*model.actuator_ctrlrange.T, (2, model.nu)).astype(np.float32), 3, axis=0)
    state = reset(jnp.asarray(qpos), jnp.zeros((6, model.nv)))
    after = np.asarray(NativeEngine(model, variants).steps(state, jnp.asarray(ctrl), 30).qpos)[:, -1]
    factor = {"mass": "body_mass", "damping": "dof_damping", "friction": "geom_friction", "motor": "actuator_gainprm"}[
        name
    ]
    for row in range(6):
        # What the variant is to be, written down once more.
        alone = copy.copy(model)
        getattr(alone, factor)[:] *= levels[row % 3]
        if name == "mass":
            alone.body_inertia *= levels[row % 3]
            mujoco.mj_setConst(alone, mujoco.MjData(alone))
        if name == "friction":
            alone.pair_friction *= levels[row % 3]
        if name == "motor":
            alone.actuator_biasprm *= levels[row % 3]
            alone.actuator_forcerange *= levels[row % 3]
        data = mujoco.MjData(alone)
        data.qpos, data.ctrl = qpos[row], ctrl[row]
        for _ in range(30):
            mujoco.mj_step(alone, data)
        np.testing.assert_allclose(after[row], data.qpos, atol=5e-3 if task == "ant_maze" else 2e-4)
    for first in (0, 3):
        assert np.abs(after[first] - after[first + 1]).max() > 1e-3
        assert np.abs(after[first] - after[first + 2]).max() > 1e-3


def test_each_condition_is_what_it_is_alone(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_ = load_run(run)
    cases = conditions(run_.task, ["motor", "latency"])
    results = evaluate_perturbed(run_.task, run_.pi, run_.actor, cases=cases, episodes=60, seed=3)
    assert [(r.condition.name, r.condition.level) for r in results][:2] == [("none", 0.0), ("motor", 0.5)]
    assert results == evaluate_perturbed(run_.task, run_.pi, run_.actor, cases=cases, episodes=60, seed=3)
    by_name = {(r.condition.name, r.condition.level): r.mean for r in results}
    assert by_name["motor", 0.5] < by_name["none", 0.0] <= by_name["motor", 1.5]
    assert by_name["latency", 4.0] <= by_name["none", 0.0]
    # In blocks of 7 starts; the mean action knows no noise, so that it does the same.
    monkeypatch.setattr(perturb, "_MAX_ROWS", 2 * 7 * len(cases))
    blocks = evaluate_perturbed(run_.task, run_.pi, run_.actor, cases=cases, episodes=60, seed=3)
    assert [r.mean for r in blocks] == [r.mean for r in results]


def test_what_has_no_answer_is_refused(run: Path) -> None:
    run_ = load_run(run)
    muscle = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' range='-60 60'/><geom size='1'/></body></worldbody>"
        "<actuator><muscle joint='j' lengthrange='0 1'/></actuator></mujoco>"
    )
    with pytest.raises(ConfigError, match="perturb=motor: the model has an actuator that is neither"):
        perturbed_model(muscle, Condition("motor", 0.5))
    heavy = perturbed_model(muscle, Condition("mass", 2.0))
    assert heavy.actuator_acc0 == muscle.actuator_acc0, "or the muscle would grow with the mass"
    ring = make_task("ring_peg", "native")  # whose contacts are frictionless
    with pytest.raises(ConfigError, match="perturb=friction: the model has none"):
        conditions(ring, ["mass", "friction"])
    assert {case.name for case in conditions(ring, ["mass", "friction"], skip=True)} == {"none", "mass"}
    mjx = run_.task.with_engine(SimpleNamespace(name="mjx"))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="needs engine=native"):
        conditions(mjx, ["mass"])
