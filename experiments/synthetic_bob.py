"""Figure 6 (appendix B.3): asymmetric self-play gets stuck once Bob knows a larger region.

    python -m experiments.synthetic_bob [seed=0]
    python -m experiments.synthetic_bob draw=1       # only draws, from the committed CSV

An open arena with the goal in its middle, and a Bob of whom only his time is known: from within r_B he returns at a
constant speed, from anywhere else never. Alice is the one of ``method=self_play``, trained by the same functions. After
``grow_after`` iterations r_B grows from ``radius`` to ``radius_later``; where she has settled she then earns nothing,
so nothing tells her where to go. Writes results/synthetic_bob.csv (a row per iteration), synthetic_bob_starts.csv (her
proposals at the iterations drawn) and synthetic_bob.png.
"""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from experiments import style
from experiments.report import RESULTS, arguments, machine, read, write_rows
from rcg_jax.config.settings import BaselineConfig, Config, CurriculumConfig, PolicyConfig, RolloutConfig, TrpoConfig
from rcg_jax.methods.self_play import BobTime, alice_iteration
from rcg_jax.physics.engine import reset
from rcg_jax.rl.agent import init_agent
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, Snapshot, StartSet

SHOWN = (1, 10, 32)
DEFAULTS = {
    "seed": 0,
    "iterations": 32,
    "radius": 2.0,  # r_B at first [m]
    "radius_later": 5.0,
    "grow_after": 10,
    "bob_speed": 0.2,  # [m per step]; Alice's is at most 0.1 along each axis
    "draw": 0,  # 1: only draws
}


class Arena(Task):
    """A point moves by up to 0.1 m per step and axis in a square of +-10 m; the goal is its middle."""

    name = "arena"
    horizon = 200

    def __init__(self) -> None:
        self.engine = cast(Any, SimpleNamespace(name="analytic"))

    @property
    def action_dim(self) -> int:
        return 2

    @property
    def goal_state(self) -> np.ndarray:
        return np.zeros(2)

    def goal_starts(self) -> StartSet:
        return StartSet(qpos=jnp.zeros((1, 2)), qvel=jnp.zeros((1, 2)), valid=jnp.ones(1, bool))

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        return reset(state.qpos + 0.1 * jnp.clip(action, -1.0, 1.0), state.qvel)

    def snapshot(self, state: PhysicsState) -> Snapshot:
        num = state.qpos.shape[0]
        points = jnp.zeros((num, 1, 3))
        return Snapshot(
            qpos=state.qpos,
            qvel=state.qvel,
            xpos=points,
            xmat=jnp.zeros((num, 1, 3, 3)),
            site_xpos=points,
            com=points[:, 0],
        )

    def observe(self, s: Snapshot) -> Array:
        return s.qpos

    def distance(self, s: Snapshot) -> Array:
        return jnp.linalg.norm(s.qpos)

    def is_goal(self, s: Snapshot) -> Array:
        return self.distance(s) < 0.1

    def is_feasible(self, s: Snapshot) -> Array:
        return jnp.all(jnp.abs(s.qpos) < 10.0)


CONFIG = Config(
    method="self_play",
    curriculum=CurriculumConfig(num_new=200, num_old=0),
    rollout=RolloutConfig(num_envs=200, batch_size=20_000),
    trpo=TrpoConfig(max_kl=0.1, gamma=0.99, fisher_fraction=0.5, cg_damping=1e-3, saturation_penalty=0.0),
    policy=PolicyConfig(hidden=[32, 32], obs_norm_iterations=0),
    baseline=BaselineConfig(minibatch_size=1_000, epochs=5),
)


def bob(radius: Array, speed: float, shared: int) -> BobTime:
    """Bob's time: distance / speed within ``radius``, else the rest of the ``shared`` horizon, at least 5 steps."""

    def time_back(key: Array, starts: StartSet, t_alice: Array) -> tuple[Array, Array]:
        distance = jnp.linalg.norm(starts.qpos, axis=1)
        steps = jnp.ceil(distance / speed).astype(jnp.int32)
        limit = jnp.maximum(5, shared - t_alice)
        t_bob = jnp.where(distance < radius, jnp.minimum(steps, limit), limit)
        return t_bob, t_bob

    return time_back


def run(args: dict[str, Any]) -> tuple[list[dict[str, Any]], dict[int, np.ndarray]]:
    """(a row per iteration, {iteration: valid proposals (K, 2)})."""
    task = Arena()
    shared = CONFIG.self_play.horizon_factor * task.horizon
    init_key, key = jax.random.split(jax.random.key(args["seed"]))

    @jax.jit
    def iteration(key: Array, alice: Any, radius: Array) -> Any:
        return alice_iteration(task, CONFIG, key, alice, bob(radius, args["bob_speed"], shared), jnp.bool_(False))

    alice = init_agent(CONFIG, init_key, 2, task.action_dim + 1)
    rows, proposals = [], {}
    for i in range(1, args["iterations"] + 1):
        radius = args["radius"] if i <= args["grow_after"] else args["radius_later"]
        alice, starts, stats = iteration(jax.random.fold_in(key, i), alice, jnp.float32(radius))
        points = np.asarray(starts.qpos)[np.asarray(starts.valid)]
        proposals[i] = points
        distance = np.linalg.norm(points, axis=1)
        rows.append(
            {
                "iteration": i,
                "radius": radius,
                "alice_reward": round(float(stats.alice_reward), 3),
                "alice_steps": round(float(stats.alice_steps), 2),
                "alice_spread": round(float(stats.alice_spread), 4),
                "distance_median": round(float(np.median(distance)), 4),
                "share_beyond_radius": round(float(np.mean(distance > radius)), 4),
            }
        )
    return rows, proposals


def draw(rows: list[dict[str, Any]], proposals: dict[int, np.ndarray], path: Path, source: dict[str, str]) -> None:
    """Alice's proposals at the iterations of Figure 6, and her reward over all of them.

    Args:
        rows: ``iteration``, ``radius`` [m] and ``alice_reward`` [steps] of each iteration.
        proposals: (K, 2) [m] at the iterations shown.
        path: of the picture.
        source: ``commit`` and ``command`` behind the numbers.
    """
    style.use()
    figure = Figure(figsize=(style.WIDTH, 3.5), layout="constrained")
    axes = figure.subplots(1, 4)
    by = {row["iteration"]: row for row in rows}
    for axis, i in zip(axes, (i for i in SHOWN if i in by), strict=False):
        known = Circle((0, 0), by[i]["radius"], color=style.colour("uniform"), alpha=0.25, lw=0, label="Bob returns")
        axis.add_patch(known)
        axis.scatter(*proposals[i].T, s=6, color=style.colour("self_play"), label="Alice's proposals")
        axis.plot(0, 0, "k+", ms=9, ls="", label="goal, where Alice begins")
        axis.set(xlim=(-6, 6), ylim=(-6, 6), aspect="equal", xlabel="x [m]", title=f"iteration {i}")
    axes[0].set_ylabel("y [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    axes[3].plot([row["iteration"] for row in rows], [row["alice_reward"] for row in rows], color="0.3", lw=1.8)
    grown = next((row["iteration"] for row in rows if row["radius"] != rows[0]["radius"]), None)
    if grown is not None:
        axes[3].axvline(grown - 0.5, color="0.5", lw=1, ls=":")
        high = max(row["alice_reward"] for row in rows)
        axes[3].annotate(" $r_B$ grows", (grown - 0.5, high / 2), color="0.4", fontsize=8)
    axes[3].set(xlabel="iteration", ylabel="mean reward [steps]", title="Alice's reward", ylim=(0, None))
    for axis in axes:
        axis.set_box_aspect(1)  # titles at one height
    style.note(figure, [f"One seed; commit {source.get('commit') or 'not recorded'}; {source.get('command', '')}."])
    style.save(figure, path)


def redraw(results: Path) -> Path:
    """Draws from the committed CSV files; returns the picture's path.

    Raises:
        FileNotFoundError: they are not there.
    """
    rows = [
        {name: float(row[name]) for name in ("iteration", "radius", "alice_reward")}
        for row in read(results / "synthetic_bob.csv")
    ]
    points = read(results / "synthetic_bob_starts.csv")
    proposals = {
        i: np.array([(float(p["x"]), float(p["y"])) for p in points if int(p["iteration"]) == i]).reshape(-1, 2)
        for i in SHOWN
    }
    source = read(results / "synthetic_bob.csv")[0]
    path = results / "synthetic_bob.png"
    draw([{**row, "iteration": int(row["iteration"])} for row in rows], proposals, path, source)
    return path


def main() -> None:
    """Runs, prints and writes the results."""
    args = arguments(DEFAULTS)
    if args["draw"]:
        print(redraw(RESULTS))
        return
    begin = time.perf_counter()
    rows, proposals = run(args)
    about = machine()
    write_rows(RESULTS / "synthetic_bob.csv", [{**row, **about} for row in rows])
    points = [
        {"iteration": i, "x": round(float(x), 3), "y": round(float(y), 3)}
        for i in SHOWN
        for x, y in proposals.get(i, np.zeros((0, 2)))
    ]
    write_rows(RESULTS / "synthetic_bob_starts.csv", points)
    redraw(RESULTS)
    for row in rows:
        if row["iteration"] in SHOWN:
            print(", ".join(f"{name} {value}" for name, value in row.items()))
    print(f"{time.perf_counter() - begin:.1f} s; {RESULTS / 'synthetic_bob.png'}")


if __name__ == "__main__":
    main()
