"""Domain randomisation: physics that differ from simulation to simulation, in training alone."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.config.settings import ConfigError, RandomizeConfig
from rcg_jax.physics.engine import reset
from rcg_jax.physics.variants import random_variants
from rcg_jax.runs.program import load_program
from rcg_jax.tasks import Task, make_task
from rcg_jax.tasks.randomize import randomized
from rcg_jax.tasks.training import training_config
from tests import tiny_run


def test_factors_are_log_uniform_within_their_spread_and_independent(ring_peg_native: Task) -> None:
    model = ring_peg_native.model
    variants = random_variants(model, {"mass": 0.5, "damping": 1.0, "friction": 0.0}, 400, seed=0)
    moving = int(np.argmax(model.body_mass))
    mass = np.array([v.body_mass[moving] / model.body_mass[moving] for v in variants])
    joint = np.unravel_index(np.argmax(model.dof_damping), model.dof_damping.shape)
    damping = np.array([v.dof_damping[joint] / model.dof_damping[joint] for v in variants])
    for factor, x in ((mass, 0.5), (damping, 1.0)):
        share = np.log(factor) / np.log(1 + x)
        assert np.abs(share).max() <= 1 + 1e-9
        assert abs(share.mean()) < 4 / np.sqrt(3 * 400)
        assert share.var() == pytest.approx(1 / 3, abs=0.06)
    assert abs(np.corrcoef(np.log(mass), np.log(damping))[0, 1]) < 4 / np.sqrt(400)
    assert all((v.geom_friction == model.geom_friction).all() for v in variants)
    for v in variants[:3]:  # what follows from masses is up to date
        fresh = mujoco.MjData(v)
        subtree = v.body_subtreemass.copy()
        mujoco.mj_setConst(v, fresh)
        np.testing.assert_allclose(v.body_subtreemass, subtree)


def test_seeds_side_by_side_have_the_variants_that_each_has_alone(ring_peg_native: Task) -> None:
    task = randomized(ring_peg_native, mass=1.0, motor=1.0, variants=3)
    rng = np.random.default_rng(0)
    qpos = jnp.asarray(np.asarray(ring_peg_native.feasible_starts().qpos)[:10].reshape(2, 5, -1))
    action = jnp.asarray(rng.uniform(-1, 1, (2, 5, task.action_dim)), jnp.float32)

    def run(qpos: jax.Array, action: jax.Array) -> jax.Array:
        return task.steps(reset(qpos, jnp.zeros((5, task.model.nv))), action, 20).qpos

    together = jax.vmap(run)(qpos, action)
    alone = jnp.stack([run(*each) for each in zip(qpos, action, strict=True)])
    np.testing.assert_array_equal(together, alone)
    # Environments one by one under vmap, as of Brax, are a batch as well.
    single = jax.vmap(lambda q, a: task.steps(reset(q[None], jnp.zeros((1, task.model.nv))), a[None], 20).qpos[0])
    np.testing.assert_array_equal(single(qpos[0], action[0]), alone[0])
    kept = pickle.loads(pickle.dumps(task))  # subprocesses get it so
    np.testing.assert_array_equal(
        kept.steps(reset(qpos[0], jnp.zeros((5, task.model.nv))), action[0], 20).qpos, alone[0]
    )
    plain = ring_peg_native.steps(reset(qpos[0], jnp.zeros((5, task.model.nv))), action[0], 20).qpos
    assert (np.abs(np.asarray(plain - alone[0]))[:, -1].max(axis=1) > 1e-4).all()


@pytest.mark.slow
def test_training_is_randomised_and_evaluation_is_not(tiny: Path, tmp_path: Path) -> None:
    plain = tiny_run.config(tmp_path)
    varied = dataclasses.replace(plain, randomize=RandomizeConfig(mass=1.0))
    programs = [load_program(config) for config in (plain, varied)]
    states = [program.init(0) for program in programs]
    evaluated = [p.make_evaluate(50)(s, jax.random.key(0)) for p, s in zip(programs, states, strict=True)]
    jax.tree.map(np.testing.assert_array_equal, *evaluated)
    after = [jax.jit(p.step)(s)[0].agent.policy for p, s in zip(programs, states, strict=True)]
    same = jax.tree.map(lambda a, b: bool((a == b).all()), *after)
    assert not all(jax.tree.leaves(same))


def test_a_program_keeps_the_physics_that_it_was_traced_with() -> None:
    first, second = make_task("ring_peg", "native"), make_task("ring_peg", "native")
    qpos, action = first.feasible_starts().qpos[:4], jnp.full((4, first.action_dim), 0.5)

    def run(task: Task) -> Any:
        return jax.jit(lambda q: task.steps(reset(q, jnp.zeros((4, task.model.nv))), action, 20).qpos)

    early = run(first)
    before = early(qpos)
    second.model.dof_damping[:] *= 2
    edited = run(second)(qpos)
    assert np.abs(np.asarray(edited - before)).max() > 1e-3
    np.testing.assert_array_equal(early(qpos), before)
    np.testing.assert_array_equal(run(make_task("ring_peg", "native"))(qpos), before)


def test_nothing_to_vary_and_what_cannot_be(ring_peg_native: Task, ring_peg_mjx: Task) -> None:
    assert randomized(ring_peg_native) is ring_peg_native
    with pytest.raises(ConfigError, match=r"randomize: weight: must be of friction, mass"):
        randomized(ring_peg_native, weight=0.1)
    with pytest.raises(ConfigError, match="needs engine=native, not mjx"):
        randomized(ring_peg_mjx, mass=0.1)
    with pytest.raises(ConfigError, match=r"randomize\.friction: the model has none"):
        randomized(ring_peg_native, friction=0.1)
    with pytest.raises(ConfigError, match=r"randomize\.mass=-1: must be a number >= 0"):
        randomized(ring_peg_native, mass=-1)
    with pytest.raises(ConfigError, match="the task varies already"):
        randomized(randomized(ring_peg_native, mass=0.1), motor=0.1)
    with pytest.raises(ConfigError, match=r"randomize\.mass=0.5: needs engine=native, not mjx"):
        training_config(["engine=mjx", "randomize.mass=0.5"])
