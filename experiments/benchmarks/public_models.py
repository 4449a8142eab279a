"""Models that nobody here wrote, one for each kind of part, trained from one goal state (examples/public_models).

python -m experiments.benchmarks.public_models writes experiments/results/public_models.csv; models whose package is not
installed are left out.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import common
from rcg_jax import init_train_state, make_task, make_train_step, training_config
from rcg_jax.config.settings import ConfigError
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.tasks.base import Task
from rcg_jax.tasks.check import check_task
from rcg_jax.train_step import TrainState

FOLDER = Path(__file__).parents[2] / "examples" / "public_models"

#: What ``task=`` says of each, its package, and what it has.
MODELS = {
    "ball_in_cup.py:BallInCup": ("dm_control", "a tendon with a limit"),
    "block_in_hand.py:BlockInHand": ("gymnasium_robotics", "a free object"),
    "franka_arm.py:FrankaArm": ("gymnasium_robotics", "meshes that collide"),
    "quadruped.py:Quadruped": ("dm_control", "actuator dynamics, equality constraints"),
    "shadow_hand.py:ShadowHand": ("gymnasium_robotics", "position servos"),
}
SETTINGS = [
    "engine=native",
    *("curriculum.num_new=40", "curriculum.num_old=20", "curriculum.num_candidates=400"),
    *("curriculum.brownian_horizon=50", "rollout.num_envs=40", "rollout.batch_size=4000", "trpo.iterations=2"),
    *("policy.hidden=[16]", "baseline.hidden=[16]", "baseline.minibatch_size=500"),
]


def train(task: Task, word: str, iterations: int) -> Iterator[tuple[TrainState, dict[str, Any]]]:
    """The train state after each iteration, and its numbers.

    ``outside``: starts outside the goal set; ``reached``: those of them from which an episode reached it.
    """
    config = with_sizes(training_config([f"task={word}", *SETTINGS]), task.horizon)
    step, state, steps = jit(make_train_step(config, task)), init_train_state(config, task, 0), 0
    for iteration in range(1, iterations + 1):
        state, metrics = step(state)
        steps += int(metrics.env_steps)
        goal = jax.vmap(task.is_goal)(task.snapshot(task.reset(state.starts)))
        outside = ~np.asarray(goal) & np.asarray(state.starts.valid)
        yield (
            state,
            {
                "iteration": iteration,
                "steps": steps,
                "success": round(float(metrics.success), 3),
                "start_distance_m": round(float(metrics.start_distance), 4),
                "outside": int(outside.sum()),
                "reached": int((np.asarray(state.labels.successes)[outside] > 0).sum()),
                "accepted": float(metrics.accepted),
                "nonfinite": int(metrics.nonfinite),
            },
        )


def main() -> int:
    """Trains all of them for 20 iterations, and keeps some."""
    enable_compilation_cache()
    about = common.machine()
    rows = []
    for name, (package, kind) in MODELS.items():
        if find_spec(package) is None:
            print(f"{name}: {package} is not installed")
            continue
        word = f"{FOLDER}/{name}"
        try:
            task = make_task(word, "native")
            check_task(task, starts=False)
        except ConfigError as error:
            print(error)
            continue
        for _, numbers in train(task, word, 20):
            print(name, numbers, flush=True)
            if numbers["iteration"] in (1, 5, 10, 20):
                rows.append({"model": name, "package": package, "kind": kind, **numbers, **about})
    common.write_rows(common.RESULTS / "public_models.csv", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
