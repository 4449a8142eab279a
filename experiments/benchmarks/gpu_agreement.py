"""How far the first TRPO update on an accelerator agrees with that on a CPU.

    python -m experiments.benchmarks.gpu_agreement  # on a machine with a GPU

Two processes, one on the CPU and one on JAX's default device, make the same agent from the same seed, roll it out from
the same starts and update it. Contacts amplify rounding, so the rollouts part slowly; the update is therefore compared
twice: each from its own rollout, and on the accelerator also from the CPU's transitions, there with matrix products
as a run computes them (``matmul_precision``) and, to show what that is worth, as others. With engine=warp the CPU has
engine=mjx. Prints a table, writes results/gpu_agreement.csv, and exits with 1 beyond the tolerances.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import RESULTS, options, write_rows
from rcg_jax.config.settings import MATMUL_PRECISIONS, Config, ConfigError, option

#: Relative differences of the update from the same transitions, and of observations after the first step, that are
#: rounding: float32 arithmetic in another order, through ten iterations of conjugate gradients.
SAME_BATCH, ONE_STEP = 2e-2, 1e-3

#: What a run uses unless told otherwise; the tolerance is for this one.
CONFIGURED = Config().matmul_precision

#: Precisions of matrix products that the update is tried at.
PRECISIONS = (CONFIGURED, *(each for each in MATMUL_PRECISIONS if each not in (CONFIGURED, "default")))


@dataclass(frozen=True)
class AgreementOptions:
    """Settings of ``python -m experiments.benchmarks.gpu_agreement``."""

    task: str = option("ring_peg", "task")
    engine: str = option("mjx", "physics engine; warp: on the accelerator, and mjx on the CPU", choices=("mjx", "warp"))
    num_envs: int = option(100, "environments", low=1)
    length: int = option(200, "steps of each", low=1)
    timeout: float = option(400.0, "seconds that a side may take", unit="s", above=0)
    out: str = option(str(RESULTS / "gpu_agreement.csv"), "CSV file")
    side: str = option("both", "both compares; cpu and device are its two processes", choices=("both", "cpu", "device"))
    folder: str = option("none", "where these two leave their arrays")


def one_side(chosen: AgreementOptions) -> None:
    """Rolls out, updates, and saves both; the device also updates from the CPU's transitions, which are there."""
    import jax
    import jax.numpy as jnp
    from jax.flatten_util import ravel_pytree

    from experiments.benchmarks.training import sized
    from rcg_jax.physics.jit import enable_compilation_cache, jit
    from rcg_jax.rl.agent import Agent, init_agent, make_policy
    from rcg_jax.rl.rollout import Sampler, Transition, begin, rollout
    from rcg_jax.rl.train_policy import segment_batch, update_agent
    from rcg_jax.tasks import make_task
    from rcg_jax.tasks.training import resolve
    from rcg_jax.types import sample_starts

    enable_compilation_cache()
    task = make_task(chosen.task, chosen.engine)
    config, _ = resolve(Config(task=chosen.task, engine=chosen.engine), ())
    config = sized(config, num_envs=chosen.num_envs, batch=chosen.num_envs * chosen.length)
    repeat = config.policy.action_repeat
    agent_key, start_key, begin_key, rollout_key, shuffle_key = jax.random.split(jax.random.key(0), 5)
    agent = init_agent(config, agent_key, task.obs_dim, task.action_dim)
    policy = make_policy(config, task.action_dim, repeat)
    starts = sample_starts(start_key, task.feasible_starts(), 90)
    env = begin(task, begin_key, starts, chosen.num_envs)
    emitters, steps = task.engine.fusion_emitters, chosen.length
    sampler = Sampler(
        task,
        lambda obs, noise: policy(agent.policy, agent.norm(obs)).sample(noise),
        repeat=repeat,
        gamma=config.trpo.gamma,
    )
    roll = lambda: rollout(  # noqa: E731
        sampler, rollout_key, env, starts, length=steps // repeat, remaining=jnp.int32(steps * config.trpo.iterations)
    )
    _, batch = jit(roll, fusion_emitters=emitters)()

    def update(agent: Agent, batch: Transition) -> tuple[Any, Any]:
        samples = segment_batch(config, shuffle_key, agent, batch)[0]
        after, stats = update_agent(config, agent, samples, learn_norm=jnp.bool_(False))
        return ravel_pytree(after.policy)[0] - ravel_pytree(agent.policy)[0], stats

    def updated(batch: Transition, precision: str) -> dict[str, Any]:
        step, stats = jit(update, fusion_emitters=emitters, matmul_precision=precision)(agent, batch)
        return {"step": step, "gain": stats.gain, "kl": stats.kl, "attempts": stats.attempts}

    arrays: dict[str, Any] = {f"batch_{name}": getattr(batch, name) for name in Transition.__dataclass_fields__}
    arrays |= {f"own_{key}": value for key, value in updated(batch, CONFIGURED).items()}
    folder = Path(chosen.folder)
    if chosen.side == "device":
        with np.load(folder / "cpu.npz") as other:
            names = Transition.__dataclass_fields__
            theirs = Transition(**{name: jnp.asarray(other[f"batch_{name}"]) for name in names})
        for precision in PRECISIONS:
            arrays |= {f"{precision}_{key}": value for key, value in updated(theirs, precision).items()}
    device = jax.devices()[0]
    arrays["device"] = f"{device.device_kind} ({device.platform})"
    saved: dict[str, Any] = {key: np.asarray(value) for key, value in arrays.items()}
    np.savez(folder / f"{chosen.side}.npz", **saved)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """|a - b| / |b|, Euclidean."""
    return float(np.linalg.norm(a - b) / max(float(np.linalg.norm(b)), 1e-30))


def compare(cpu: Mapping[str, np.ndarray], device: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Rows ``quantity``, ``value``, and where there is one ``tolerance`` and ``met``.

    Args:
        cpu, device: what the two sides saved.
    """
    rows: list[dict[str, Any]] = []

    def add(quantity: str, value: float, tolerance: float | None = None) -> None:
        met = "" if tolerance is None else value <= tolerance
        rows.append({"quantity": quantity, "value": float(f"{value:.4g}"), "tolerance": tolerance or "", "met": met})

    first, other = cpu["batch_next_obs"], device["batch_next_obs"]
    for step in sorted({1, 20, 100, len(first)}):
        if step <= len(first):
            error = np.abs(first[step - 1] - other[step - 1]).max(axis=-1)
            add(f"observations after step {step}, median of the largest differences", float(np.median(error)))
    add("observations after step 1, relative difference", relative(other[0], first[0]), ONE_STEP)
    same = (cpu["batch_done"] == device["batch_done"]) & (cpu["batch_success"] == device["batch_success"])
    add("share of environments whose episodes end alike", float(same.all(axis=0).mean()))
    for precision in PRECISIONS:
        name = f"update from the same transitions, matrix products {precision}"
        tolerance = SAME_BATCH if precision == CONFIGURED else None
        difference = relative(device[f"{precision}_step"], cpu["own_step"])
        add(f"{name}: relative difference of the step", difference, tolerance)
        add(f"{name}: relative difference of the KL", relative(device[f"{precision}_kl"], cpu["own_kl"]))
    a, b = cpu["own_step"], device["own_step"]
    add("update from its own rollout: relative difference of the step", relative(b, a))
    size = max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-30)
    add("update from its own rollout: cosine of the two steps", float(a @ b) / size)
    for key in ("gain", "kl", "attempts"):
        add(f"update from its own rollout: {key}, CPU", float(cpu[f"own_{key}"]))
        add(f"update from its own rollout: {key}, device", float(device[f"own_{key}"]))
    return rows


def run_side(side: str, chosen: AgreementOptions, folder: Path) -> dict[str, np.ndarray]:
    """Runs one side in a process of its own and loads what it saved.

    Raises:
        RuntimeError: it failed; its last line.
    """
    engine = "mjx" if side == "cpu" else chosen.engine
    settings = {"task": chosen.task, "engine": engine, "num_envs": chosen.num_envs, "length": chosen.length}
    words = [f"{key}={value}" for key, value in {**settings, "side": side, "folder": folder}.items()]
    env = {**os.environ, **({"JAX_PLATFORMS": "cpu"} if side == "cpu" else {})}
    command = [sys.executable, "-m", "experiments.benchmarks.gpu_agreement", *words]
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=chosen.timeout)
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"the {side} side took longer than {chosen.timeout:g} s") from None
    if done.returncode:
        raise RuntimeError(f"the {side} side: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}")
    with np.load(folder / f"{side}.npz") as arrays:
        return dict(arrays)


def both(chosen: AgreementOptions, run: Callable[[str, AgreementOptions, Path], dict[str, np.ndarray]]) -> int:
    """Runs both sides, prints and writes what :func:`compare` finds; returns the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        sides = {}
        for side in ("cpu", "device"):
            print(f"{side}: rollout and update ...", flush=True)
            sides[side] = run(side, chosen, Path(folder))
    rows = compare(sides["cpu"], sides["device"])
    device = str(sides["device"]["device"])
    print(f"CPU against {device}, matrix products {CONFIGURED}")
    for row in rows:
        bound = f"  <= {row['tolerance']:g}: {row['met']}" if row["tolerance"] else ""
        print(f"{row['quantity']:95s} {row['value']:10.4g}{bound}")
    from experiments.common import commit

    about = {
        "task": chosen.task,
        "engine": chosen.engine,
        "device": device,
        "precision": CONFIGURED,
        "commit": commit(),
    }
    write_rows(Path(chosen.out), [{**row, **about} for row in rows])
    return 1 if any(row["met"] is False for row in rows) else 0


def main() -> int:
    """Compares, or is one of the two sides; returns the exit code."""
    chosen = options(AgreementOptions, "experiments.benchmarks.gpu_agreement")
    try:
        if chosen.side == "both":
            return both(chosen, run_side)
        one_side(chosen)
    except (ConfigError, RuntimeError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
