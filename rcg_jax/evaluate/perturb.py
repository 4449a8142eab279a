"""How much a policy loses in a world that is not quite the one it was trained in.

The model's friction, masses, damping and motors are scaled; the policy's observations get noise, and its actions arrive
late. Each condition stands alone, and all of them run side by side from the same starts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rcg_jax.config.settings import ConfigError
from rcg_jax.evaluate.regions import Cell
from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.physics.engine import UnsupportedModelError
from rcg_jax.physics.jit import jit
from rcg_jax.physics.native import NativeEngine
from rcg_jax.physics.variants import SCALES, scaled
from rcg_jax.rl.episodes import Disturbance, run_episodes
from rcg_jax.rl.policy import Actor, GaussianPolicy
from rcg_jax.tasks.base import Task
from rcg_jax.types import StartSet, sample_rows

#: What can be perturbed: its levels and what they are.
PERTURBATIONS: dict[str, tuple[tuple[float, ...], str]] = {
    "friction": ((0.5, 0.7, 1.3, 1.5), "friction of all contacts, times"),
    "mass": ((0.5, 0.7, 1.3, 1.5), "masses and inertias of all bodies, times"),
    "damping": ((0.5, 0.7, 1.3, 1.5), "damping of all joints, times"),
    "motor": ((0.5, 0.7, 1.3, 1.5), "force of all actuators, times"),
    "latency": ((1.0, 2.0, 4.0), "actions that an action arrives late"),
    "noise": ((0.03, 0.1, 0.3), "noise of what the policy sees: of the observations, in standard deviations of each"),
}


#: Simulations side by side, at most: their states under one action are in memory together.
_MAX_ROWS = 8_000


@dataclass(frozen=True)
class Condition:
    """A perturbation, one of :data:`PERTURBATIONS`, and its level; ``none``: the world as it was."""

    name: str
    level: float


@dataclass(frozen=True)
class Robustness:
    """What E episodes under one condition showed; rates of success, of the stochastic policy with a 95 % interval."""

    condition: Condition
    episodes: int
    stochastic: float
    low: float
    high: float
    mean: float


def parse_perturbations(text: str) -> list[str]:
    """The perturbations in ``perturb=``: ``all``, or some of them with commas between.

    Raises:
        ConfigError: one that is not known.
    """
    names = list(PERTURBATIONS) if text == "all" else text.split(",")
    for name in names:
        if name not in PERTURBATIONS:
            raise ConfigError(f"perturb={text}: {name or 'an empty name'} is none of {', '.join(PERTURBATIONS)}, all")
    return list(dict.fromkeys(names))


def conditions(task: Task, names: Sequence[str], *, skip: bool = False) -> list[Condition]:
    """All levels of some perturbations, after the world as it is.

    Args:
        task: task, on ``engine=native``.
        names: perturbations.
        skip: leaves out what the model has nothing of, instead of refusing it.

    Raises:
        ConfigError: the task is on another engine, or its model has nothing of that kind.
    """
    if task.engine.name != NativeEngine.name:
        raise ConfigError(f"perturb: needs engine=native, not {task.engine.name}")
    found = [Condition("none", 0.0)]
    for name in names:
        levels = [Condition(name, level) for level in PERTURBATIONS[name][0]]
        try:
            perturbed_model(task.model, levels[0])
        except ConfigError:
            if not skip:
                raise
        else:
            found += levels
    return found


def perturbed_model(model: mujoco.MjModel, condition: Condition) -> mujoco.MjModel:
    """``model`` under a condition; one that is about observations or actions leaves it as it is.

    Raises:
        ConfigError: the model has no such thing.
    """
    if condition.name not in SCALES:
        return model
    try:
        return scaled(model, {condition.name: condition.level})
    except UnsupportedModelError as error:
        raise ConfigError(f"perturb={error}") from None


def evaluate_perturbed(
    task: Task, policy: GaussianPolicy, actor: Actor, *, cases: Sequence[Condition], episodes: int, seed: int
) -> list[Robustness]:
    """Success on rho_0 under each condition, from the same starts.

    Args:
        task: task, on ``engine=native``.
        policy: pi.
        actor: its parameters and observation statistics.
        cases: K conditions (:func:`conditions`).
        episodes: E episodes of the stochastic policy, and as many of its mean, for each condition.
        seed: random seed of starts and actions.

    Raises:
        ConfigError: the task is on another engine, or its model has nothing of that kind.
        FileNotFoundError: the task has no feasible set.
    """
    if task.engine.name != NativeEngine.name:
        raise ConfigError(f"perturb: needs engine=native, not {task.engine.name}")
    k = len(cases)
    perturbed = task.with_engine(NativeEngine(task.model, [perturbed_model(task.model, case) for case in cases]))
    feasible = task.feasible_starts()
    block = min(episodes, max(1, _MAX_ROWS // (2 * k)))  # starts at a time
    noise, delay = (
        jnp.tile(jnp.asarray([case.level if case.name == name else 0.0 for case in cases]), 2 * block)
        for name in ("noise", "latency")
    )
    longest = int(max(case.level for case in cases if case.name in ("none", "latency")))

    def evaluate(actor: Actor, starts: StartSet, key: jax.Array) -> jax.Array:
        """Successes (2, block, K) from a block of starts: of the stochastic policy, and of its mean."""
        action_key, sensor_key = jax.random.split(key)
        rows = jnp.repeat(jnp.tile(jnp.arange(block), 2), k)  # of one start all conditions, then of the next
        result = run_episodes(
            perturbed,
            policy,
            actor,
            action_key,
            starts.take(rows),
            deterministic=jnp.arange(len(rows)) >= block * k,
            disturbance=Disturbance(sensor_key, noise, delay.astype(jnp.int32), longest),
        )
        return result.success.reshape(2, block, k)

    compiled = jit(evaluate, fusion_emitters=True)
    start_key, key = jax.random.split(jax.random.key(seed))
    chosen = np.asarray(sample_rows(start_key, feasible, episodes))
    blocks = [np.resize(chosen[i : i + block], block) for i in range(0, episodes, block)]
    keys = jax.random.split(key, len(blocks))
    solved = [compiled(actor, feasible.take(jnp.asarray(rows)), one) for rows, one in zip(blocks, keys, strict=True)]
    stochastic, mean = np.concatenate(solved, axis=1)[:, :episodes].sum(axis=1)
    return [
        Robustness(case, episodes, s / episodes, *wilson_interval(int(s), episodes), m / episodes)
        for case, s, m in zip(cases, stochastic.tolist(), mean.tolist(), strict=True)
    ]


def robustness_table(results: Sequence[Robustness], action_seconds: float) -> str:
    """Success under each condition as text; actions are held for so many seconds."""
    base = results[0].stochastic
    lines = [f"{'perturbed':<12}{'level':>8}{'success':>10}  {'95 % interval':<15}{'mean action':>12}{'change':>9}"]
    for one in results:
        name, level = one.condition.name, one.condition.level
        shown = {"none": "-", "latency": f"{1000 * level * action_seconds:.0f} ms"}.get(name, f"{level:g}")
        interval = f"[{one.low:.3f}, {one.high:.3f}]"
        change = "" if name == "none" else f"{one.stochastic - base:+.3f}"
        lines.append(f"{name:<12}{shown:>8}{one.stochastic:>10.3f}  {interval:<15}{one.mean:>12.3f}{change:>9}")
    return "\n".join(lines)


#: Columns of a CSV file with robustness.
ROBUSTNESS_COLUMNS = (
    *("command", "task", "method", "training_seed", "iteration", "env_steps", "seed", "action_s"),
    *("perturbed", "level", "episodes", "success_stochastic", "success_stochastic_low", "success_stochastic_high"),
    "success_mean",
)


def robustness_rows(results: Sequence[Robustness], about: Mapping[str, Cell]) -> list[dict[str, Cell]]:
    """Rows of :data:`ROBUSTNESS_COLUMNS`; ``about``: the first eight, the same in all of them."""
    cells = ((r.condition.name, r.condition.level, r.episodes, r.stochastic, r.low, r.high, r.mean) for r in results)
    own = ROBUSTNESS_COLUMNS[len(about) :]
    return [{**about, **dict(zip(own, row, strict=True))} for row in cells]
