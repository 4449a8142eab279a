"""Our own row of the race: the documented command, whose checkpoints are kept as snapshots while it runs."""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common import options
from experiments.race.snapshots import Predict, elapsed, name
from rcg_jax.config.settings import option


@dataclass(frozen=True)
class OurOptions:
    """Settings of ``python -m experiments.race.ours``."""

    task: str = option("ring_peg", "task")
    trainer: str = option("ours", "train_pol: TRPO, or PPO", choices=("ours", "ours_ppo"))
    seed: int = option(0, "seed", low=0)
    minutes: float = option(30.0, "time limit", low=0.01)
    folder: str = option("runs/race/ours", "where snapshots go")
    iterations: int = option(300, "curriculum iterations at most", low=1)
    every: int = option(2, "iterations between checkpoints", low=1)


def main() -> int:
    """Runs the command and copies each of its checkpoints; ends it at the time limit."""
    chosen = options(OurOptions, "experiments.race.ours")
    folder = Path(chosen.folder)
    run_dir, kept = folder / "run", folder / "snapshots"
    kept.mkdir(parents=True)
    words = [f"task={chosen.task}", f"seed={chosen.seed}", f"iterations={chosen.iterations}"]
    words += [f"checkpoint_every={chosen.every}", "write_report=false", f"run_dir={run_dir}"]
    words += ["algorithm=ppo"] if chosen.trainer == "ours_ppo" else []
    process = subprocess.Popen([sys.executable, "-m", "rcg_jax.run", *words])
    checkpoints = run_dir / chosen.task / "reverse" / f"seed{chosen.seed}" / "checkpoints"
    seen: dict[str, float] = {}
    while process.poll() is None and elapsed() < 60 * chosen.minutes:
        _collect(checkpoints, kept, seen)
        time.sleep(0.2)
    stopped = process.poll() is None
    if stopped:
        process.terminate()
    code = process.wait()
    _collect(checkpoints, kept, seen)
    if code and not stopped:
        return code
    _rename(kept, checkpoints.parent)
    return 0


def _collect(checkpoints: Path, kept: Path, seen: dict[str, float]) -> None:
    """Copies new checkpoints, which appear under their final names when they are whole."""
    for path in checkpoints.glob("[0-9]*"):
        if path.name not in seen and path.name.isdecimal():
            seen[path.name] = elapsed()
            shutil.copytree(path, kept / f"{seen[path.name]:08.1f}_at{path.name}")


def _rename(kept: Path, run: Path) -> None:
    """Puts environment steps in the place of iterations."""
    import csv

    with (run / "metrics.csv").open() as file:
        steps = {int(row["iteration"]): int(float(row["env_steps"])) for row in csv.DictReader(file)}
    for path in list(kept.iterdir()):
        seconds, _, iteration = path.name.partition("_at")
        path.rename(kept / name(float(seconds), steps[int(iteration)]))
    shutil.copy(run / "config.yaml", kept.parent / "config.yaml")


@functools.cache
def _task(name: str) -> Any:
    from rcg_jax.tasks import make_task

    return make_task(name, "native")


def load(path: Path, trainer: str, task: str) -> Predict:
    """A checkpoint as a function of observations."""
    from rcg_jax.rl.agent import make_policy
    from rcg_jax.runs.checkpoint import load as load_checkpoint
    from rcg_jax.runs.settings import read_config
    from rcg_jax.train_step import init_train_state

    config, built = read_config(path.parent.parent), _task(task)
    like = jax.eval_shape(lambda: init_train_state(config, built, 0))
    actor = load_checkpoint(path, like).agent.actor
    policy = make_policy(config, built.action_dim, config.policy.action_repeat)

    @jax.jit
    def act(obs: jax.Array, noise: jax.Array) -> jax.Array:
        return policy(actor.policy, actor.norm(obs)).sample(noise)

    rng = np.random.default_rng(0)

    def predict(obs: np.ndarray, mean: bool) -> np.ndarray:
        noise = np.zeros((len(obs), built.action_dim), np.float32)
        return np.asarray(act(obs, noise if mean else rng.standard_normal(noise.shape, np.float32)))

    return predict


if __name__ == "__main__":
    sys.exit(main())
