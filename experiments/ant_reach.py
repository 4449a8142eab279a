"""What the ant could reach: can its tilted starts be righted, and does a trained policy get to the goal from there?

    python -m experiments.ant_reach                          # about six minutes on 2 cores
    python -m experiments.ant_reach policy=FILE.npz starts=20

A fifth of ant_maze's starts is tilted by more than 37 degrees, and policies learn those last. Whether it is the
policy that lacks something, or the motors, a search tells: for each of these starts the cross-entropy method looks
for torques, without any feedback, that bring the ant upright and leave it standing. From where they leave it the
trained policy goes on, with what is left of T. Where that arrives, the goal can be reached from this start within T,
since a controller did it. Every start has a few tries of the policy alone, too. So both together are a lower bound of
what one controller could reach on rho_0, as ``experiments.ring_reach`` gives an upper one for the ring.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

from experiments.report import RESULTS, in_one_line, machine, options, write_rows
from experiments.trained import subjects
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.rl.episodes import run_episodes
from rcg_jax.runs.load import Trained
from rcg_jax.stats import wilson_interval
from rcg_jax.tasks.ant_maze import AntMaze
from rcg_jax.types import StartSet

#: Tilted: the cosine of the torso's angle to the vertical is below the first. Righted: at the end it is above the
#: second.
TILTED, RIGHTED = 0.8, 0.9

#: Steps of a search's torques, steps without any after them, steps that a knot of the torques is held for.
MOVE, REST, KNOT = 100, 40, 5

#: Of the search: action sequences of a start and generation, those that the next one is made from, how much of it is
#: made from them, first and least standard deviation.
POPULATION, ELITE, PULL, FIRST_STD, LEAST_STD = 64, 8, 0.7, 0.6, 0.1

#: Starts searched side by side, and ways of righting each that are kept.
_SIDE_BY_SIDE, _KEPT = 64, 4


@dataclass(frozen=True)
class AntReachOptions:
    """Settings of ``python -m experiments.ant_reach``."""

    policy: str = option(
        "ant_maze", "a shipped policy of ant_maze, or a file *.npz, that goes on once the ant is upright"
    )
    run: str = option("none", "instead of policy: a seed's folder")
    starts: int = option(0, "tilted starts to search for, the first of a random order; 0: all", low=0)
    generations: int = option(25, "generations of the search", low=1)
    tries: int = option(
        4, "episodes of the policy from each state that it goes on from, and from each other start", low=1
    )
    seed: int = option(0, "random seed", low=0, high=2**31 - 1)
    results: str = option(str(RESULTS), "folder of the CSV file")


def upright(qpos: np.ndarray) -> np.ndarray:
    """Cosine of the torso's angle to the vertical, (...), of positions (..., nq)."""
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    return 1.0 - 2.0 * (x * x + y * y) / (w * w + x * x + y * y + z * z)


@dataclass
class Outcome:
    """How sequences of torques ended.

    Attributes:
        qpos, qvel: (K, nq), (K, nv) where they left the ant.
        fell: (K,) the step at which its height left the allowed range; ``MOVE + REST`` where it never did.
        tilt: (K,) mean of :func:`upright` over the last half of the rest.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    fell: np.ndarray
    tilt: np.ndarray

    @property
    def righted(self) -> np.ndarray:
        """(K,) bool: upright at the end, without a fall on the way."""
        return (self.fell == MOVE + REST) & (upright(self.qpos) > RIGHTED)

    @property
    def score(self) -> np.ndarray:
        """(K,) what the search maximises: first not to fall for long, then to stand upright."""
        alive = self.fell == MOVE + REST
        return np.where(alive, 1.0 + self.tilt, self.fell / (MOVE + REST) - 1.0)


def play_torques(task: AntMaze, batch: Batch, qpos: np.ndarray, actions: np.ndarray) -> Outcome:
    """Torques (K, MOVE / KNOT, nu) in [-1, 1], then none, from rest at positions (K, nq); K is the batch's size."""
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
    at, speed, warm, ctrl = (batch.bind(name) for name in names)
    low, high = task.model.actuator_ctrlrange.T
    at[:], speed[:], warm[:] = qpos, 0.0, 0.0
    fell = np.full(len(qpos), MOVE + REST)
    tilt = np.zeros(len(qpos))
    for t in range(MOVE + REST):
        ctrl[:] = low + (actions[:, t // KNOT] + 1.0) / 2.0 * (high - low) if t < MOVE else 0.0
        batch.step()
        height = np.array(at[:, 2])
        out = ~((height >= task.heights[0]) & (height <= task.heights[1]))  # where it is NaN, too
        fell = np.where(out & (fell == MOVE + REST), t, fell)
        if t >= MOVE + REST // 2:
            tilt += upright(np.array(at)) / (REST - REST // 2)
    return Outcome(np.array(at), np.array(speed), fell, np.nan_to_num(tilt, nan=-1.0))


def search(task: AntMaze, qpos: np.ndarray, generations: int, rng: np.random.Generator) -> list[list[np.ndarray]]:
    """For each start (N, nq) up to four states ``[qpos, qvel]`` in which some torques leave the ant upright."""
    num, knots, nu = len(qpos), MOVE // KNOT, task.model.nu
    batch = Batch(task.model, num * POPULATION)
    mean, std = np.zeros((num, knots, nu)), np.full((num, knots, nu), FIRST_STD)
    found: list[list[np.ndarray]] = [[] for _ in range(num)]
    for _ in range(generations):
        noise = rng.standard_normal((num, POPULATION, knots, nu))
        actions = np.clip(mean[:, None] + std[:, None] * noise, -1.0, 1.0)
        outcome = play_torques(task, batch, np.repeat(qpos, POPULATION, 0), actions.reshape(-1, knots, nu))
        for k in np.flatnonzero(outcome.righted):
            if len(found[k // POPULATION]) < _KEPT:
                found[k // POPULATION].append(np.concatenate([outcome.qpos[k], outcome.qvel[k]]))
        best = np.argsort(-outcome.score.reshape(num, POPULATION), axis=1)[:, :ELITE]
        elite = np.take_along_axis(actions, best[:, :, None, None], axis=1)
        mean = PULL * elite.mean(1) + (1.0 - PULL) * mean
        std = np.maximum(PULL * elite.std(1) + (1.0 - PULL) * std, LEAST_STD)
    return found


def arrivals(run: Trained, states: np.ndarray, steps: int, tries: int, seed: int) -> np.ndarray:
    """(K,) how many of ``tries`` episodes of at most ``steps`` steps arrive, every second with the mean action.

    Args:
        states: (K, nq + nv) where they begin.
    """
    nq = run.task.model.nq
    rows = np.repeat(states, tries, 0).astype(np.float32)
    starts = StartSet(jnp.asarray(rows[:, :nq]), jnp.asarray(rows[:, nq:]), jnp.ones(len(rows), bool))
    by_mean = jnp.arange(len(rows)) % tries % 2 == 1

    def play(key: jax.Array) -> jax.Array:
        return run_episodes(run.task, run.pi, run.actor, key, starts, by_mean, steps).success

    success = jit(play, fusion_emitters=run.task.engine.fusion_emitters)(jax.random.key(seed))
    return np.asarray(success).reshape(-1, tries).sum(1)


def measure(chosen: AntReachOptions) -> dict[str, Any]:
    """The row of the CSV file.

    Raises:
        ConfigError: the policy cannot be loaded, is of another task, or none of its starts is tilted.
    """
    found = subjects("all" if chosen.run != "none" else chosen.policy, chosen.run)
    if len(found) != 1:
        raise ConfigError(f"policy={chosen.policy}: give one")
    run = found[0].load("native")
    task = run.task
    if not isinstance(task, AntMaze):
        word = f"run={chosen.run}" if chosen.run != "none" else f"policy={chosen.policy}"
        raise ConfigError(f"{word}: must be of ant_maze, this one is of {run.task_name}")
    rng = np.random.default_rng(chosen.seed)
    qpos = np.asarray(task.feasible_starts().qpos, float)
    is_tilted = upright(qpos) < TILTED
    tilted, others = rng.permutation(qpos[is_tilted]), qpos[~is_tilted]
    tilted = tilted[: chosen.starts or len(tilted)]
    if not len(tilted):
        raise ConfigError(f"task={run.task_name}: none of its starts is tilted")
    begin, ways = time.monotonic(), []
    for k in range(0, len(tilted), _SIDE_BY_SIDE):
        ways += search(task, tilted[k : k + _SIDE_BY_SIDE], chosen.generations, rng)
        done, spent = len(ways), time.monotonic() - begin
        left = spent / done * (len(tilted) - done)
        print(f"{done} of {len(tilted)} tilted starts: {sum(map(bool, ways))} righted, ETA {left:.0f} s", flush=True)

    at_rest = np.concatenate(
        [np.concatenate([tilted, others]), np.zeros((len(tilted) + len(others), task.model.nv))], 1
    )
    alone = arrivals(run, at_rest, task.horizon, chosen.tries, chosen.seed)
    owner = np.repeat(np.arange(len(tilted)), [len(way) for way in ways])
    then = np.zeros(len(tilted), bool)
    if len(owner):
        states = np.array([state for way in ways for state in way])
        arrived = arrivals(run, states, task.horizon - MOVE - REST, chosen.tries, chosen.seed) > 0
        np.logical_or.at(then, owner, arrived)
    righted = np.array([bool(way) for way in ways])
    either = then | (alone[: len(tilted)] > 0)
    share = float(is_tilted.mean())
    other = float((alone[len(tilted) :] > 0).mean())
    low, high = wilson_interval(int(either.sum()), len(tilted))
    return {
        "policy": found[0].name,
        "tilted_share": round(share, 4),
        "tilted": len(tilted),
        "righted": round(float(righted.mean()), 4),
        "righted_and_arrived": round(float(then.mean()), 4),
        "tilted_reached": round(float(either.mean()), 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "tilted_policy": round(float(alone[: len(tilted)].mean() / chosen.tries), 4),
        "others": len(others),
        "others_policy": round(float(alone[len(tilted) :].mean() / chosen.tries), 4),
        "others_reached": round(other, 4),
        "reached": round(share * float(either.mean()) + (1.0 - share) * other, 4),
        "tries": chosen.tries,
        "generations": chosen.generations,
        "seed": chosen.seed,
        "starts_sha256": task.starts_sha256(),
        **machine(),
    }


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the CSV file for a page."""
    lines = [
        "| starts | share of rho_0 | policy alone | righted by the search | reached: policy, or search then policy |",
        "|" + "---|" * 5,
    ]
    for row in rows:
        names = ("tilted_share", "tilted_policy", "righted", "tilted_reached", "low", "high")
        share, alone, righted, reached, low, high = (float(row[name]) for name in names)
        lines += [
            f"| tilted ({row['tilted']}) | {share:.3f} | {alone:.3f} | {righted:.3f} "
            f"| {reached:.3f} [{low:.3f}, {high:.3f}] |",
            f"| others ({row['others']}) | {1 - share:.3f} | {float(row['others_policy']):.3f} | "
            f"| {float(row['others_reached']):.3f} |",
            f"| all | 1 | | | {float(row['reached']):.3f} |",
        ]
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Searches, prints and writes; returns the exit code."""
    chosen = options(AntReachOptions, "experiments.ant_reach")
    enable_compilation_cache()
    row = measure(chosen)
    path = Path(chosen.results) / "ant_reach.csv"
    write_rows(path, [row])
    print(f"{markdown([{key: str(value) for key, value in row.items()}])}\n\n{path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
