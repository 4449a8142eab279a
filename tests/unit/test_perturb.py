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
from rcg_jax.evaluate.perturb import Condition, evaluate_perturbed, perturbed_model
from rcg_jax.physics.engine import reset
from rcg_jax.physics.native import NativeEngine
from rcg_jax.rl.episodes import Disturbance, Episodes, run_episodes
from rcg_jax.rl.policy import ObsNormalizer
from rcg_jax.runs.load import load_run
from rcg_jax.tasks import Task
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


@pytest.mark.parametrize("name", ["mass", "friction", "damping", "motor"])
def test_simulations_have_the_physics_of_their_own_variant(ring_peg_native: Task, name: str) -> None:
    model = copy.copy(ring_peg_native.model)
    before = [np.array(getattr(model, field)) for field in ("body_mass", "geom_friction", "dof_damping")]
    variants = [perturbed_model(model, Condition(name, level)) for level in (1.0, 0.5, 1.5)]
    for field, value in zip(("body_mass", "geom_friction", "dof_damping"), before, strict=True):
        np.testing.assert_array_equal(getattr(model, field), value)
    rng = np.random.default_rng(0)
    starts = ring_peg_native.feasible_starts()
    qpos = np.repeat(np.asarray(starts.qpos)[:2], 3, axis=0)
    ctrl = np.repeat(rng.uniform(-1, 1, (2, model.nu)).astype(np.float32), 3, axis=0) * 20
    after = NativeEngine(model, variants).steps(
        reset(jnp.asarray(qpos), jnp.zeros((6, model.nv))), jnp.asarray(ctrl), 20
    )
    for row in range(6):
        data, alone = mujoco.MjData(variants[row % 3]), variants[row % 3]
        data.qpos, data.ctrl = qpos[row], ctrl[row]
        for _ in range(20):
            mujoco.mj_step(alone, data)
        np.testing.assert_allclose(after.qpos[row, -1], data.qpos, atol=2e-4)
    if name != "friction":  # without contact it changes nothing
        assert np.abs(np.asarray(after.qpos)[0, -1] - np.asarray(after.qpos)[2, -1]).max() > 1e-3


def test_each_condition_is_what_it_is_alone(run: Path) -> None:
    run_ = load_run(run)
    names = ["motor", "latency"]
    results = evaluate_perturbed(run_.task, run_.pi, run_.actor, names=names, episodes=60, seed=3)
    assert [(r.condition.name, r.condition.level) for r in results][:2] == [("none", 0.0), ("motor", 0.5)]
    again = evaluate_perturbed(run_.task, run_.pi, run_.actor, names=names, episodes=60, seed=3)
    assert results == again
    weak = {r.condition.level: r.mean for r in results if r.condition.name == "motor"}
    assert weak[0.5] < results[0].mean <= weak[1.5]
    late = [r.mean for r in results if r.condition.name == "latency"]
    assert late[-1] <= results[0].mean


def test_what_has_no_answer_is_refused(run: Path) -> None:
    run_ = load_run(run)
    muscle = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' range='-60 60'/><geom size='1'/></body></worldbody>"
        "<actuator><muscle joint='j' lengthrange='0 1'/></actuator></mujoco>"
    )
    with pytest.raises(ConfigError, match="perturb=motor: the model has an actuator that is neither"):
        perturbed_model(muscle, Condition("motor", 0.5))
    mjx = copy.copy(run_.task)
    mjx.engine = SimpleNamespace(name="mjx")  # type: ignore[assignment]
    with pytest.raises(ConfigError, match="needs engine=native"):
        evaluate_perturbed(mjx, run_.pi, run_.actor, names=["mass"], episodes=1, seed=0)
