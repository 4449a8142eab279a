"""Brax PPO as a rival, on our environment: engine=native on a CPU, where MJX would cost it a factor; mjx elsewhere."""

from __future__ import annotations

import contextlib
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common import options
from experiments.race.snapshots import Predict, elapsed, name
from rcg_jax.config.settings import option

#: Like Brax's and Playground's settings for arms (unroll 10 to 30, discount 0.97 to 0.99, entropy 1e-2), for few cores.
SETTINGS: dict[str, Any] = {
    "num_envs": 128,
    "unroll_length": 20,
    "batch_size": 128,
    "num_minibatches": 8,
    "num_updates_per_batch": 8,
    "discounting": 0.99,
    "gae_lambda": 0.95,
    "learning_rate": 3e-4,
    "entropy_cost": 1e-3,
    "normalize_observations": True,
    "clipping_epsilon": 0.2,
}


@dataclass(frozen=True)
class BraxOptions:
    """Settings of ``python -m experiments.race.brax_ppo``."""

    trainer: str = option("brax_ppo", "always brax_ppo")
    task: str = option("ring_peg", "task")
    seed: int = option(0, "seed", low=0)
    minutes: float = option(30.0, "time limit", low=0.01)
    folder: str = option("runs/race/brax_ppo", "where snapshots go")
    every: int = option(250_000, "actions between snapshots", low=1)


class _OutOfTimeError(Exception):
    pass


def _restore_device_put_replicated() -> None:
    """Brax 0.14.2 calls a function that JAX 0.10 no longer has."""
    vars(jax)["device_put_replicated"] = lambda tree, devices: jax.tree.map(
        lambda x: jax.numpy.stack([x] * len(devices)), tree
    )


def main() -> int:
    """Trains until the time limit."""
    from brax.training.agents.ppo import train as ppo

    from rcg_jax.brax import TaskEnv

    chosen = options(BraxOptions, "experiments.race.brax_ppo")
    _restore_device_put_replicated()
    folder = Path(chosen.folder) / "snapshots"
    folder.mkdir(parents=True)
    env = TaskEnv(chosen.task, engine="native" if jax.default_backend() == "cpu" else "mjx")

    def keep(step: int, make_policy: Any, params: Any) -> None:
        now = elapsed()
        path = folder / f"{name(now, step * env.action_repeat)}.pickle"
        path.write_bytes(pickle.dumps(jax.device_get(params)))
        print(f"{now:7.0f} s  {step * env.action_repeat:>11,} env steps", flush=True)
        if now >= 60 * chosen.minutes:
            raise _OutOfTimeError

    evals = 10_000
    with contextlib.suppress(_OutOfTimeError):
        ppo.train(
            environment=env,
            num_timesteps=chosen.every * evals,
            num_evals=evals + 1,
            num_resets_per_eval=1,
            episode_length=env.episode_length,
            seed=chosen.seed,
            policy_params_fn=keep,
            run_evals=False,
            **SETTINGS,
        )
    return 0


def load(path: Path, trainer: str, task: str) -> Predict:
    """A snapshot as a function of observations."""
    from brax.training.acme import running_statistics
    from brax.training.agents.ppo import networks

    from rcg_jax.tasks import make_task

    params, built = pickle.loads(path.read_bytes()), make_task(task, "native")
    made = networks.make_ppo_networks(
        built.obs_dim, built.action_dim, preprocess_observations_fn=running_statistics.normalize
    )
    inference = networks.make_inference_fn(made)
    act = {mean: jax.jit(inference(params, deterministic=mean)) for mean in (False, True)}
    keys = iter(jax.random.split(jax.random.key(0), 100_000))

    def predict(obs: np.ndarray, mean: bool) -> np.ndarray:
        return np.asarray(act[mean](obs, next(keys))[0])

    return predict


if __name__ == "__main__":
    sys.exit(main())
