"""Models that nobody here wrote, one for each kind of part, train from one goal state (examples/public_models)."""

from __future__ import annotations

from importlib.util import find_spec

import jax
import numpy as np
import pytest

from experiments.benchmarks.public_models import FOLDER, MODELS, train
from rcg_jax import make_task
from rcg_jax.tasks.check import check_task


def test_all_of_them_are_here() -> None:
    assert {name.split(":")[0] for name in MODELS} == {path.name for path in FOLDER.glob("*.py")}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_it_trains(name: str) -> None:
    if find_spec(MODELS[name][0]) is None:
        pytest.skip(f"{MODELS[name][0]} is not installed")
    task = make_task(f"{FOLDER}/{name}", "native")
    check_task(task, starts=False)
    states, history = zip(*train(task, f"{FOLDER}/{name}", 4), strict=True)
    assert all(numbers["accepted"] > 0 for numbers in history)  # TRPO steps
    assert all(numbers["success"] > 0 for numbers in history)
    assert not any(numbers["nonfinite"] for numbers in history)
    assert sum(numbers["reached"] for numbers in history)  # from starts outside the goal set
    starts = states[-1].starts
    assert np.abs(np.asarray(starts.qpos) - task.goal_state)[np.asarray(starts.valid)].max() > 1e-3  # the walks
    first, last = (state.agent.policy for state in (states[0], states[-1]))
    assert max(jax.tree.leaves(jax.tree.map(lambda a, b: float(np.abs(a - b).max()), first, last))) > 0
