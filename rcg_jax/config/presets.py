"""Training settings as data: what the presets and the paper's tasks train with instead of the defaults.

Precedence: what the user says, then the preset, then the task, then the defaults of :class:`rcg_jax.config.Config`.
``preset=paper`` trains every task as the paper does, so there the task has no say.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: ``preset=``: settings by dotted name. The paper's text and appendix; where these are silent, or where the authors'
#: software differs from them, what that ran with (fixed std 1, lambda 1, Fisher products over the configured batch,
#: integrated noise, labels 0 < R < 1). The paper keeps every old start; 200,000 keeps 100 good ones of each of 2,000
#: iterations.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "paper": {
        "curriculum.num_new": 200,
        "curriculum.num_old": 100,
        "curriculum.num_candidates": 10_000,
        "curriculum.selection": "random",
        "curriculum.rho_0_share": 0.0,
        "curriculum.walk_rounds": 1,
        "curriculum.replay_capacity": 200_000,
        "curriculum.brownian_horizon_max": 50,
        "curriculum.noise": "integrated",
        "curriculum.min_good": 0.0,
        "curriculum.outward_share": 1.0,
        "curriculum.stall_walk": 10,
        # The authors' software labels by default arguments, 0 < R < 1: a start is good if some of its episodes succeed
        # and some fail. The text says 0.1 and 0.9.
        "curriculum.r_min": 0.001,
        "curriculum.r_max": 0.999,
        "rollout.batch": "episodes",
        "rollout.batch_size": 50_000,
        "trpo.gae_lambda": 1.0,
        "trpo.fisher_fraction": 1.0,
        "trpo.step_scale": 1.0,
        "trpo.saturation_penalty": 0.0,
        "trpo.full_step_failures": 0.0,
        "policy.init_std": 1.0,
        "policy.learn_std": False,
        "policy.action_repeat": 1,
        "policy.obs_norm_iterations": 0,
        "iterations": 2_000,
    },
}

#: Training settings of the paper's tasks. Subclasses inherit them; custom classes have a ``training`` of their own.
TASK_SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "ant_maze": {
        # Noise of standard deviation 1 throws the ant over: every episode that misses the goal then ends with a fall.
        "policy.init_std": 0.5,
        # Larger steps, and a V that follows them (docs/studies.md has what they do).
        "trpo.max_kl": 0.03,
        "trpo.gae_lambda": 0.95,
        "baseline.hidden": [64, 64],
        "baseline.epochs": 5,
    },
    # 0.01 s a step is finer than an arm needs to react: held actions let the noise get further, and fewer decisions
    # share the credit.
    "ring_peg": {"policy.action_repeat": 4},
    "key_insertion": {"policy.action_repeat": 4},
}
