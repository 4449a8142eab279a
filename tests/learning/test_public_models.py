"""Models that nobody here wrote, one for each kind of part, train from one goal state (examples/public_models)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np
import pytest

from rcg_jax import init_train_state, make_task, make_train_step, training_config
from rcg_jax.physics.jit import jit
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.tasks.check import check_task

FOLDER = Path(__file__).parents[2] / "examples" / "public_models"
MODELS = {
    "ball_in_cup.py:BallInCup": "dm_control",
    "block_in_hand.py:BlockInHand": "gymnasium_robotics",
    "franka_arm.py:FrankaArm": "gymnasium_robotics",
    "quadruped.py:Quadruped": "dm_control",
    "shadow_hand.py:ShadowHand": "gymnasium_robotics",
}
SMALL = [
    "engine=native",
    *("curriculum.num_new=40", "curriculum.num_old=20", "curriculum.num_candidates=400"),
    *("curriculum.brownian_horizon=50", "rollout.num_envs=40", "rollout.batch_size=4000", "trpo.iterations=2"),
    *("policy.hidden=[16]", "baseline.hidden=[16]", "baseline.minibatch_size=500"),
]


def test_all_of_them_are_here() -> None:
    assert {name.split(":")[0] for name in MODELS} == {path.name for path in FOLDER.glob("*.py")}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_it_trains(name: str) -> None:
    if find_spec(MODELS[name]) is None:
        pytest.skip(f"{MODELS[name]} is not installed")
    word = f"{FOLDER}/{name}"
    task = make_task(word, "native")
    if task.model.na and not hasattr(task, "neutral_act"):
        pytest.skip("activations are no state of simulations yet")
    check_task(task, starts=False)
    config = with_sizes(training_config([f"task={word}", *SMALL]), task.horizon)
    step, state, outside = jit(make_train_step(config, task)), init_train_state(config, task, 0), 0
    before = state.agent.policy
    for _ in range(4):
        state, metrics = step(state)
        snapshot = task.snapshot(task.reset(state.starts))
        away = ~np.asarray(jax.vmap(task.is_goal)(snapshot)) & np.asarray(state.starts.valid)
        outside += int((np.asarray(state.labels.successes)[away] > 0).sum())
        assert int(metrics.nonfinite) == 0
        assert float(metrics.accepted) > 0  # TRPO steps
        assert float(metrics.success) > 0
    moved = np.abs(np.asarray(state.starts.qpos) - task.goal_state)[np.asarray(state.starts.valid)]
    assert moved.max() > 1e-3  # the walks
    assert outside  # starts that are not in the goal set, and from which the goal was reached
    changed = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), state.agent.policy, before)
    assert max(jax.tree.leaves(changed)) > 0
