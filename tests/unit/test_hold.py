"""Actions held for several physics steps, against the same physics stepped one by one in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax import task_from_mujoco
from rcg_jax.config.settings import Config, ConfigError, PolicyConfig, RolloutConfig
from rcg_jax.methods.self_play import alice_episodes
from rcg_jax.rl.agent import init_agent, make_policy
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.rl.hold import decisions, hold
from rcg_jax.rl.rollout import Sampler, begin, label_starts, rollout
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.rl.train_policy import fisher_samples
from rcg_jax.train_step import make_train_step
from tests.analytic import Line, make_starts

K = 3


def test_a_model_without_sites_can_hold_its_actions() -> None:
    xml = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1"/></body>
    </worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
    task = task_from_mujoco(mujoco.MjSpec.from_string(xml), point="cart", goal_state=[0.0])("native")
    state = task.reset(make_starts([[x] for x in (-0.1, 0.2)]))
    after, s, (distance, bad) = hold(task, state, jnp.ones((2, 1)), 3, task.distance)
    assert (s.site_xpos.shape, distance.shape, bad.shape) == ((2, 0, 3), (3, 2), (3, 2))
    np.testing.assert_allclose(distance[-1], np.abs(after.qpos[:, 0]), rtol=1e-5)


def by_hand(
    task: Line, x: float, actions: np.ndarray, repeat: int, gamma: float, weight: float
) -> list[dict[str, Any]]:
    """One episode of a :class:`Line`: a row for each action until the episode ends."""
    rows, age = [], 0
    for a in actions:
        row = {"success": False, "terminal": False, "reward": 0.0, "bad": False}
        for j in range(repeat):
            x += task.gain * float(np.clip(a, -1, 1))
            age += 1
            goal, failure, bad = abs(x) < task.goal_radius, x > task.fail_above, x > task.bad_above
            row["reward"] += gamma**j * ((goal and not bad) - (0.0 if bad else weight * abs(x)))
            row |= {"success": goal and not bad, "terminal": goal or failure or bad, "bad": bad, "age": age}
            if row["terminal"] or age >= task.horizon:
                break
        rows.append(row | {"done": row["terminal"] or age >= task.horizon})
        if rows[-1]["done"]:
            break
    return rows


@pytest.mark.parametrize("repeat", [1, 2, 3, 7])
@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_rollouts_are_the_physics_stepped_one_by_one(repeat: int, weight: float) -> None:
    """Goal, failure, non-finite physics and a horizon that is no multiple of k, in the middle of a held action."""
    # A line ends at the right in one of two ways.
    limits = {"fail_above": 0.95} if weight else {"bad_above": 0.95}
    task = Line(horizon=20, gain=0.03, goal_radius=0.031, **limits)
    starts = make_starts([[x, 0, i] for i, x in enumerate([-0.1, 0.06, 0.9, 0.3, -0.5])])
    num, length, gamma = 400, 25, 0.9
    env = begin(task, jax.random.key(0), starts, num)
    sampler = Sampler(task, lambda obs, noise: noise, repeat=repeat, gamma=gamma, distance_weight=weight)
    roll = jax.jit(
        lambda key, env: rollout(sampler, key, env, starts, length=length, remaining=jnp.int32(length * repeat))
    )
    _, batch = jax.tree.map(np.asarray, roll(jax.random.key(1), env))
    kinds = {"success": 0, "failure": 0, "late": 0}
    longest = decisions(task.horizon, repeat) * repeat
    for n in range(num):
        row = 0
        while row < length:
            x = float(starts.qpos[batch.start[row, n], 0])
            expected = by_hand(task, x, batch.action[row:, n, 0], repeat, gamma, weight)
            counted = (length - row) * repeat >= longest
            for j, want in enumerate(expected):
                for name in ("success", "terminal", "done", "bad", "age"):
                    assert getattr(batch, name)[row + j, n] == want[name], (name, row, j, n)
                np.testing.assert_allclose(batch.reward[row + j, n], want["reward"], atol=1e-5)
                assert batch.counted[row + j, n] == counted
            last = expected[-1]
            if last["done"]:
                kinds["success" if last["success"] else "failure" if last["terminal"] else "late"] += 1
            row += len(expected)
    assert min(kinds.values()) > 10
    labels = label_starts(batch, starts.capacity)
    ended = batch.done & batch.counted
    assert int(labels.episodes.sum()) == ended.sum() > 0
    assert int(labels.steps.sum()) == batch.age[ended & batch.success].sum()


def test_episodes_end_in_the_step_that_reaches_the_goal() -> None:
    """A policy that pushes with full force to the right, from starts a known number of steps away."""
    task = Line(horizon=20, gain=0.04, goal_radius=0.021, feasible_radius=2.0)
    steps = np.array([1, 2, 3, 4, 10, 19, 20, 21, 40])
    starts = make_starts([[-0.04 * k, 0, 0] for k in steps])
    config = Config(policy=PolicyConfig(hidden=[4], output_gain=0.0, init_std=1e-6))
    for repeat in (1, 3, 4, 8):
        policy = make_policy(config, 1, repeat)
        agent = init_agent(config, jax.random.key(0), 2, 1)
        pushing = jax.tree.map(lambda x: x, agent.policy.mlp)
        pushing["params"]["Dense_1"]["bias"] = jnp.array([1.0])
        agent = agent.replace(policy=agent.policy.replace(mlp=pushing))
        seen = run_episodes(task, policy, agent, jax.random.key(1), starts, deterministic=True)
        np.testing.assert_array_equal(seen.success, steps <= 20)
        np.testing.assert_array_equal(seen.length, np.minimum(steps, 20))
        limit = jnp.full(len(steps), 7)
        short = run_episodes(task, policy, agent, jax.random.key(1), starts, deterministic=True, horizon=limit)
        np.testing.assert_array_equal(short.length, np.minimum(steps, 7))
        np.testing.assert_array_equal(short.success, steps <= 7)


def sizes(config: Config, horizon: int, share: int = 1) -> tuple[int, int]:
    """Environments and steps of a TRPO iteration."""
    rollout = with_sizes(config, horizon, share).rollout
    return rollout.num_envs, rollout.batch_size


def test_sizes_count_physics_steps() -> None:
    for repeat in range(1, 21):
        config = Config(policy=PolicyConfig(action_repeat=repeat))
        envs, batch = sizes(config, 500)
        assert batch % (envs * repeat) == 0
        assert 20_000 <= batch < 20_000 + envs * repeat
        assert 50 <= envs <= 100
        assert batch * config.trpo.iterations >= 2 * envs * 500
        for devices in (3, 8):
            envs, batch = sizes(config, 500, devices)
            assert envs % devices == 0
            assert envs >= 48
            assert batch % (envs * repeat) == 0
        of_mine = dataclasses.replace(config, rollout=RolloutConfig(num_envs=50))
        assert sizes(of_mine, 500)[1] % (50 * repeat) == 0
    assert sizes(Config(), 500) == (100, 20_000)


def test_sizes_that_do_not_fit_are_refused() -> None:
    def refusal(repeat: int, batch: int = 0) -> str:
        config = Config(policy=PolicyConfig(action_repeat=repeat), rollout=RolloutConfig(batch_size=batch))
        with pytest.raises(ConfigError) as caught:
            make_train_step(config, Line(horizon=40))
        return str(caught.value)

    assert refusal(41) == "policy.action_repeat=41: must be <= 40, the steps of an episode"
    assert "rollout.batch_size=20002: must be a multiple of policy.action_repeat=4" in refusal(4, 20_002)


def test_the_fisher_sample_is_as_large_as_of_the_same_steps() -> None:
    """Without held actions a share of the batch, whatever its size."""
    assert [fisher_samples(Config(), batch) for batch in (10, 5_000, 20_000, 80_000)] == [1, 250, 1_000, 4_000]
    assert fisher_samples(Config(), 5_000, 4) == 1_000
    assert fisher_samples(Config(), 1_250, 4) == 250
    assert fisher_samples(Config(), 20_000, 4) == 1_000


def test_alice_acts_as_seldom_as_bob() -> None:
    task = Line(horizon=20, gain=0.01)
    config = Config(policy=PolicyConfig(hidden=[4], action_repeat=K))
    alice = init_agent(config, jax.random.key(0), 2, 2)
    seen = jax.jit(lambda key: alice_episodes(task, config, key, alice, num=200, horizon=40))(jax.random.key(1))
    assert seen.action.shape[0] == decisions(40, K) == 14
    clock = np.asarray(seen.proposals.qpos[:, 1])
    stopped = np.asarray(seen.proposals.valid)
    assert stopped.sum() > 50
    np.testing.assert_array_equal(np.asarray(seen.length)[stopped], clock[stopped])
    assert set(np.asarray(seen.length) % K) == {0}
