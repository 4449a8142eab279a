"""Policies out of runs: at their end, by ``python -m rcg_jax.export``; and what their cards say about the tasks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import export
from rcg_jax.config.settings import ConfigError, EvalConfig
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.policies.policy_file import load_policy, policy_arrays
from rcg_jax.runs import checkpoint
from rcg_jax.runs import train as loop
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.load import load_policy_with_task, load_run
from rcg_jax.runs.program import load_program
from rcg_jax.runs.progress import Reporter
from rcg_jax.runs.recorder import read_evaluation
from rcg_jax.tasks import TASKS, Task, make_task
from rcg_jax.types import StartSet
from tests import tiny_run


@pytest.fixture(scope="module")
def finished(tiny: Path) -> Path:
    """Two seeds, trained but for the end of their run, and then that."""
    config = dataclasses.replace(
        tiny_run.config(tiny / "finished"),
        num_seeds=2,
        iterations=3,
        evaluation=EvalConfig(episodes=10, final_episodes=40),
    )
    folders = [RunFolder(config, seed) for seed in (0, 1)]
    for seed, folder in enumerate(folders):
        folder.open()
        folder.write_config()
        folder.close()
        rows = "".join(f"{k},{2000 * k},1,1\n" for k in (1, 2, 3))
        folder.metrics_file.write_text("iteration,env_steps,wall_s,steps_per_s\n" + rows)
        state = tiny_run.trained(folder.config).replace(iteration=jnp.int32(3))
        policy = state.agent.policy.replace(log_std=jnp.full(2, -1.0 - seed))
        checkpoint.save([folder.checkpoints], 3, [state.replace(agent=state.agent.replace(policy=policy))])
    load = lambda config: dataclasses.replace(load_program(config), pictures=lambda folder: None)  # noqa: E731
    loop.run(config, report=Reporter(), command="again", load=load)
    return folders[0].path.parent


@pytest.mark.slow
def test_a_finished_run_has_its_policy(finished: Path, tmp_path: Path) -> None:
    numbers = []
    for seed in (0, 1):
        folder = finished / f"seed{seed}"
        policy, state = load_policy(folder), load_run(folder).state
        for name, array in policy_arrays(state.agent.actor).items():
            np.testing.assert_array_equal(policy_arrays(policy.actor)[name], array)
        card = policy.card
        assert (card.task, card.method, card.seed, card.iteration, card.env_steps) == ("tiny", "reverse", seed, 3, 6000)
        evaluation = read_evaluation(folder / "eval.csv", 3)
        assert evaluation is not None
        assert card.stochastic.episodes == card.mean.episodes == evaluation.episodes == 40
        assert card.stochastic.successes == evaluation.successes_stochastic
        assert card.mean.successes == evaluation.successes_mean
        assert (card.mean.low, card.mean.high) == pytest.approx(wilson_interval(card.mean.successes, 40), abs=1e-6)
        assert card.starts_sha256 == evaluation.starts_sha256
        # The command writes the same, from the checkpoint and eval.csv.
        out = tmp_path / f"{seed}.npz"
        assert export.main([f"run={folder}", f"out={out}"]) == 0
        assert out.read_bytes() == (folder / "policy.npz").read_bytes()
        assert out.with_suffix(".json").read_bytes() == (folder / "policy.json").read_bytes()
        numbers.append(card.arrays_sha256)
    assert numbers[0] != numbers[1]


def test_a_run_without_an_evaluation_is_evaluated(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main([f"run={run}", "episodes=20"]) == 0
    said = capsys.readouterr().out
    card = load_policy(run).card
    assert (card.iteration, card.stochastic.episodes) == (3, 20)
    assert f"success on rho_0 {card.stochastic.rate:.3f}" in said
    assert 0 < card.stochastic.successes < 20
    assert card.actuators == ("x", "y")
    assert card.ctrl_low == (-4.0, -4.0)
    assert card.timestep_s == 0.02
    assert card.observation[0].size == 4
    assert card.starts_sha256 == make_task("tiny", "native").starts_sha256()


def test_a_policy_of_an_own_task_asks_for_it(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert export.main([f"run={run}", "episodes=5", f"out={tmp_path / 'one.npz'}"]) == 0
    monkeypatch.delitem(TASKS, "tiny")
    with pytest.raises(ConfigError, match=r"its task tiny is none of .*; add task=path/to/file.py:tiny"):
        load_policy_with_task(tmp_path / "one.npz")
    # Any task will do that observes and acts alike; others are refused.
    assert load_policy_with_task(tmp_path / "one.npz", task="point_maze").task.name == "point_maze"
    with pytest.raises(ConfigError, match="it is for observations of length 4, task=ring_peg has 17"):
        load_policy_with_task(tmp_path / "one.npz", task="ring_peg")


def test_a_model_that_cannot_be_written_whole_is_refused(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tiny_run.Tiny, "make_model", lambda self: Task.make_model(self))
    assert export.main(["task=tiny", f"out={tmp_path / 'a.xml'}"]) == 2
    assert "has to override make_spec as well" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module", params=["point_maze", "ant_maze", "ring_peg", "key_insertion"])
def task(request: pytest.FixtureRequest) -> Task:
    return TASKS[request.param]("native")


def test_sources_of_observations_are_what_the_task_observes(task: Task) -> None:
    starts = task.feasible_starts().take(np.array([0, 100, 500]))
    qvel = np.random.default_rng(0).normal(size=starts.qvel.shape).astype(np.float32)
    expected = jax.jit(task.observe_batch)(task.reset(StartSet(starts.qpos, qvel, starts.valid)))
    parts = task.observation_parts()
    assert all(part.source and part.unit for part in parts)
    data = mujoco.MjData(task.model)
    for i in range(3):
        data.qpos[:], data.qvel[:] = starts.qpos[i], qvel[i]
        mujoco.mj_forward(task.model, data)
        found = [np.ravel(eval(part.source, {"data": data})) for part in parts]
        assert [len(one) for one in found] == [part.size for part in parts]
        np.testing.assert_allclose(np.concatenate(found), expected[i], atol=2e-5)


def test_the_exported_model_moves_as_the_tasks(task: Task, tmp_path: Path) -> None:
    assert export.main([f"task={task.name}", f"out={tmp_path / 'model.xml'}"]) == 0
    alone = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert (alone.nq, alone.nu, alone.npair) == (task.model.nq, task.model.nu, task.model.npair)
    np.testing.assert_allclose(alone.actuator_ctrlrange, task.model.actuator_ctrlrange)
    assert alone.opt.timestep == task.model.opt.timestep
    ends = []
    for model in (alone, task.model):
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = task.goal_state, 0.3 * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data, 20)
        ends.append(data.qpos.copy())
    assert np.abs(ends[0] - task.goal_state).max() > 1e-3
    np.testing.assert_allclose(*ends, atol=1e-3)
