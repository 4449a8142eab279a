"""Appendix B.2: where policies of the point maze succeed, and which way they push, seed by seed.

    python -m experiments.uniform_failure run_dir=runs/reproduce/cpu    # measures the runs there, then draws
    python -m experiments.uniform_failure                               # draws from the committed CSV

From uniform starts some policies "only learned how to perform well from a certain side of the goal", because the first
successes all came from there. On a lattice of points in every open cell the stochastic policy begins ``episodes``
episodes at rest; ``results/policy_<task>.csv`` has the successes and the mean action of each point, and
``uniform_failure.png`` shows all seeds of the curriculum and of uniform starts, with the paper's values and with ours,
none of them picked.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from experiments import style
from experiments.collect import changed, digest, present
from experiments.curves import seeds_text
from experiments.plan import SEEDS
from experiments.provenance import combined
from experiments.report import RESULTS, in_one_line, locked, options, read, require, write_rows
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.runs.settings import read_config, read_values

#: Points of the lattice along an edge of a cell.
LATTICE = 4

#: Methods that the figure compares.
METHODS = ("uniform", "reverse")

#: Its rows, a method and a preset each; those of the paper's values only where there are such maps.
ROWS = tuple((method, preset) for preset in ("paper", "default") for method in METHODS)


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.uniform_failure``."""

    run_dir: str = option("none", "folder of runs to measure, at any depth; none: only draw")
    task: str = option("point_maze", "a maze whose positions are x and y")
    episodes: int = option(8, "episodes per point", low=1)
    results: str = option(str(RESULTS), "folder of the CSV file and of the picture")


def lattice(centres: np.ndarray, size: float) -> np.ndarray:
    """Points (K * 16, 2) in open cells with ``centres`` (K, 2) and edges of ``size`` [m]."""
    offset = ((np.arange(LATTICE) + 0.5) / LATTICE - 0.5) * size
    inside = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    return (centres[:, None] + inside).reshape(-1, 2)


def measure(run: Path, episodes: int) -> list[dict[str, Any]]:
    """Rows of a run's newest policy: a point, its successes, the mean action there at rest.

    Raises:
        ConfigError: the run cannot be loaded, or is of no maze of points.
    """
    # Here, so that drawing does not wait for it.
    import jax
    import jax.numpy as jnp

    from rcg_jax.physics.jit import jit
    from rcg_jax.rl.episodes import run_episodes
    from rcg_jax.runs.load import load_run
    from rcg_jax.tasks.maze_task import MazeTask
    from rcg_jax.types import StartSet

    loaded = load_run(run)
    task, agent = loaded.task, loaded.state.agent
    if not isinstance(task, MazeTask) or task.model.nq != 2:
        raise ConfigError(f"run={run}: task={loaded.config.task} is no maze of points")
    points = lattice(task.maze.open_centres, task.maze.size)
    policy = loaded.pi
    starts = StartSet.at_rest(jnp.asarray(np.repeat(points, episodes, axis=0), jnp.float32), task.model.nv)

    def look(agent: Any, key: Any) -> tuple[Any, Any]:
        obs = agent.norm(task.observe_batch(task.reset(starts)))
        return run_episodes(task, policy, agent, key, starts).success, policy(agent.policy, obs).mean

    fusion = task.engine.fusion_emitters
    success, action = jax.device_get(jit(look, fusion_emitters=fusion)(agent, jax.random.key(0)))
    success = np.asarray(success).reshape(len(points), episodes).sum(axis=1)
    action = np.asarray(action).reshape(len(points), episodes, -1)[:, 0]
    config = loaded.config
    return [
        {
            "method": config.method,
            "reward": config.reward,
            "preset": config.preset,
            "seed": config.seed,
            "settings": " ".join(changed(config)),
            "config": digest(read_values(run / "config.yaml")),
            "iteration": loaded.iteration,
            "commit": combined(run)["commit"],
            "x": f"{x:g}",
            "y": f"{y:g}",
            "successes": int(wins),
            "episodes": episodes,
            "action_x": round(float(push[0]), 3),
            "action_y": round(float(push[1]), 3),
        }
        for (x, y), wins, push in zip(points, success, action, strict=True)
    ]


def measure_all(run_dir: Path, task: str, episodes: int, table: Path) -> int:
    """Measures the finished runs of the figure below a folder into the CSV file; returns how many there were.

    Raises:
        ResultsError: the CSV file is damaged, or another program's.
    """
    from rcg_jax.physics.jit import enable_compilation_cache

    enable_compilation_cache()
    _known(table)  # damaged: before anything is measured
    found: dict[Key, list[dict[str, Any]]] = {}
    for path in sorted(run_dir.rglob("seed*/config.yaml")):
        run = path.parent
        try:
            config = read_config(run)
            if (config.task, config.reward) != (task, "sparse") or (config.method, config.preset) not in ROWS:
                continue
            # The policy of an unfinished run has learned less than the others: no fair map.
            if (done := last_iteration(run)) < config.iterations:
                print(f"{run}: left out: {done} of {config.iterations} iterations")
                continue
            rows = measure(run, episodes)
        except ConfigError as error:
            print(f"{run}: left out: {' '.join(str(error).split())}", file=sys.stderr)
            continue
        found[_key(rows[0])] = rows
        print(f"{run}: success {np.mean([row['successes'] for row in rows]) / episodes:.2f}", flush=True)
    if not found:
        return 0
    with locked(table.parent):
        known = _known(table)
        for key, rows in found.items():
            if key in known and int(known[key][0]["iteration"]) > rows[0]["iteration"]:
                print(f"{' '.join(filter(None, key))}: {table.name} has a policy of more iterations; kept")
                continue
            known.pop(key, None)
            known[key] = rows  # the newest last
        write_rows(table, [{**dict.fromkeys(_COLUMNS, ""), **row} for rows in known.values() for row in rows])
    return len(found)


#: What a map is known by: method, preset, seed, settings, and the digest of all of them.
Key = tuple[str, str, str, str, str]

#: Columns of the CSV file.
_COLUMNS = ("method", "reward", "preset", "seed", "settings", "config", "iteration", "commit", "x", "y", "successes",
            "episodes", "action_x", "action_y")  # fmt: skip


def _key(row: dict[str, Any]) -> Key:
    return row["method"], row["preset"], str(row["seed"]), row["settings"], row.get("config", "")


def _of_today(key: Key) -> bool:
    """Whether a map is of its preset as it is now."""
    return key[3:] == ("", present(key[1], "point_maze"))


def _known(table: Path) -> dict[Key, list[dict[str, Any]]]:
    """The maps of the CSV file.

    Raises:
        ResultsError: it is damaged, or another program's.
    """
    rows = read(table) if table.exists() else []
    require(table, rows, [name for name in _COLUMNS if name != "config"])
    maps: dict[Key, list[dict[str, Any]]] = {}
    for row in rows:
        maps.setdefault(_key(row), []).append(row)
    return maps


def last_iteration(run: Path) -> int:
    """Of a run's newest checkpoint; 0 where there is none."""
    folder = run / "checkpoints"
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return max((int(name) for name in names if name.isdecimal()), default=0)


def _map(axes: Axes, rows: Sequence[dict[str, str]], goal: tuple[float, float] | None) -> None:
    """Success as colour, the mean action as arrows, on the lattice."""
    columns = {name: np.array([float(row[name]) for row in rows]) for name in ("x", "y", "action_x", "action_y")}
    rate = np.array([int(row["successes"]) / int(row["episodes"]) for row in rows])
    step = float(np.min(np.diff(np.unique(columns["x"]))))
    low = np.array([columns["x"].min(), columns["y"].min()])
    place = np.rint((np.stack([columns["x"], columns["y"]], axis=1) - low) / step).astype(int)
    image = np.full(place.max(axis=0)[::-1] + 1, np.nan)
    image[place[:, 1], place[:, 0]] = rate
    high = low + step * (np.array(image.shape[::-1]) - 1)
    extent = (low[0] - step / 2, high[0] + step / 2, low[1] - step / 2, high[1] + step / 2)
    axes.set_facecolor("0.82")
    axes.imshow(image, origin="lower", extent=extent, cmap=_COLOURS, vmin=0, vmax=1, interpolation="nearest")
    push = np.stack([columns["action_x"], columns["action_y"]], axis=1)
    # What exceeds the actuators' range is clipped to it.
    push = np.clip(push, -1, 1)
    # Every second point of the lattice: all of them would be a carpet.
    shown = (place.sum(axis=1) % 2 == 0) & (place[:, 0] % 2 == 0)
    axes.quiver(
        columns["x"][shown], columns["y"][shown], push[shown, 0], push[shown, 1],
        pivot="mid", scale=0.62 / step, scale_units="xy", angles="xy", width=0.008, headwidth=4.5, color="0.15",
    )  # fmt: skip
    if goal:
        axes.plot(*goal, marker="*", ms=11, color="#FFD21F", mec="0.1", mew=0.8)
    axes.grid(visible=False)
    # A rim of wall.
    rim = 1.2 * step
    axes.set(xlim=(extent[0] - rim, extent[1] + rim), ylim=(extent[2] - rim, extent[3] + rim))
    axes.set(xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_visible(False)


#: From nowhere solved to everywhere: light vermilion to light green, on which dark arrows can be read.
_COLOURS = ListedColormap(
    np.array(
        [
            np.interp(np.linspace(0, 1, 64), [0, 0.5, 1], channel)
            for channel in ((0.93, 0.98, 0.55), (0.60, 0.93, 0.84), (0.47, 0.72, 0.68))
        ]
    ).T
)


def _goal(task: str) -> tuple[float, float] | None:
    """Where the goal is."""
    from rcg_jax.tasks import TASKS

    x, y = getattr(TASKS.get(task), "goal", None) or (None, None)
    return None if x is None or y is None else (float(x), float(y))


def draw(results: Path, task: str = "point_maze") -> tuple[Path | None, list[str]]:
    """Draws the figure; returns its path, None without any runs, and what is missing."""
    style.use()
    table = results / f"policy_{task}.csv"
    maps: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    every = _known(table)
    # Of several settings, those of the present defaults, else what was measured last.
    for key, rows in sorted(every.items(), key=lambda item: _of_today(item[0])):
        maps[key[0], key[1], int(key[2])] = rows
    shown = [row for row in ROWS if row[1] == "default" or any(key[:2] == row for key in maps)]
    how = f'make reproduce BUDGET=cpu ARGS="task={task} method={",".join(METHODS)}"'
    figure = Figure(figsize=(style.WIDTH, 0.75 + 2.0 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), len(SEEDS), squeeze=False)
    for (method, preset), line in zip(shown, grid, strict=True):
        for seed, axes in zip(SEEDS, line, strict=True):
            mine = maps.get((method, preset, seed))
            if mine is None:
                style.empty(axes, "not run yet")
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(False)
            else:
                _map(axes, mine, _goal(task))
                rate = np.mean([int(row["successes"]) / int(row["episodes"]) for row in mine])
                axes.set_title(f"seed {seed}: {rate:.2f}", loc="center", fontweight="normal", fontsize=10)
        name = style.label(method).partition(" (")[0] + "\npreset=paper" * (preset == "paper")
        line[0].set_ylabel(name, fontweight="bold", color=style.colour(method))
    colours = figure.colorbar(ScalarMappable(Normalize(0, 1), _COLOURS), ax=grid, shrink=0.7, aspect=28, pad=0.01)
    colours.set_label("success from there")
    colours.outline.set_visible(False)  # type: ignore[operator]
    note = "Arrows: the policy's mean action at rest. Star: goal. In titles: mean over the lattice. "
    if maps:
        one = next(iter(maps.values()))[0]
        commits = sorted({rows[0]["commit"] or "not recorded" for rows in maps.values()})
        ends = sorted({int(rows[0]["iteration"]) for rows in maps.values()})
        settings = sorted({rows[0]["settings"] for rows in maps.values()} - {""})
        note += (
            f"{style.title(task)}, {one['episodes']} episodes of the stochastic policy per point, policies after "
            f"{', '.join(map(str, ends))} iterations; all finished runs ({len(maps)}){'; '.join(['', *settings])}; "
            f"commit {', '.join(commits)}."
        )
        earlier = sum(not rows[0]["settings"] and not _of_today(_key(rows[0])) for rows in maps.values())
        note += f" {earlier} of them made with other defaults than today's." if earlier else ""
        note += f" {len(every) - len(maps)} with other settings are not drawn." if len(every) > len(maps) else ""
    style.note(figure, [note])
    absent = {
        " ".join([method, "preset=paper"][: 1 + (preset == "paper")]): [
            seed for seed in SEEDS if (method, preset, seed) not in maps
        ]
        for method, preset in shown
    }
    lacking = [f"{method} ({seeds_text(seeds)})" for method, seeds in absent.items() if seeds]
    path = style.save(figure, results / "uniform_failure.png") if maps else None
    return path, [f"{task} lacks maps of {', '.join(lacking)}: {how}"] if lacking else []


@in_one_line
def main() -> int:
    """Measures if a folder of runs is given, then draws; returns the exit code: 2 if there is nothing to measure."""
    chosen = options(FigureOptions, "experiments.uniform_failure")
    out = Path(chosen.results)
    if chosen.run_dir != "none":
        run_dir = Path(chosen.run_dir)
        if not run_dir.is_dir():
            print(f"error: run_dir={run_dir}: no such folder", file=sys.stderr)
            return 2
        if not measure_all(run_dir, chosen.task, chosen.episodes, out / f"policy_{chosen.task}.csv"):
            what = f"{' or '.join(METHODS)} runs of {chosen.task}"
            print(f"error: run_dir={run_dir}: no finished {what} there to measure", file=sys.stderr)
            return 2
    path, lacking = draw(out, chosen.task)
    print("\n".join([str(path or "nothing to draw yet"), *lacking]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
