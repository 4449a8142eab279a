"""What a policy reaches if an episode may last longer than T: is the horizon the limit, or the policy?

    python -m experiments.horizon                              # all shipped policies, then the picture
    python -m experiments.horizon policy=ring_peg episodes=500
    python -m experiments.horizon run=runs/ring_peg/reverse/seed0
    python -m experiments.horizon draw=1                       # only the picture, from the committed CSV

The same policy begins at the same starts with the same noise and gets 4 T steps; as an episode ends when it reaches the
goal, this one rollout says what the success would be with any shorter horizon. The policy was trained for T.

``horizon.csv`` has the success after t steps: of all episodes at every tenth of T, and at T, 2 T and 4 T also by
distance of the start and by the task's parts of S^0. ``horizon.png`` shows the former. Rows of other policies stay.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import style
from experiments.report import in_one_line, machine, options, read
from experiments.trained import ACTIONS, Subject, fewer, folder, merge, play, rate, starts, subjects
from rcg_jax.config.settings import option
from rcg_jax.evaluation.regions import Region, make_regions
from rcg_jax.physics.jit import enable_compilation_cache

#: Longest horizon in units of T, those that are looked at closely, and points of the curve per T.
LONGEST, CLOSELY, POINTS = 4, (1, 2, 4), 10

_COLOURS = {"stochastic": "#0072B2", "mean": "#009E73"}
_LABELS = {"stochastic": "stochastic policy", "mean": "its mean action"}


@dataclass(frozen=True)
class HorizonOptions:
    """Settings of ``python -m experiments.horizon``."""

    policy: str = option("all", "shipped policies or files *.npz, separated by commas; all: every shipped one")
    run: str = option("none", "instead of policy: folder of a seed")
    episodes: int = option(1_000, "episodes of each policy; proportionally fewer where T is more than 500 steps", low=1)
    seed: int = option(0, "random seed of starts and actions", low=0, high=2**31 - 1)
    results: str = option("default", "folder of CSV file and picture; default: experiments/results, or the run's own")
    draw: int = option(0, "1: only draw the picture from the CSV file", low=0, high=1)


def _cells(region: Region, actions: str) -> dict[str, Any]:
    successes = region.successes_mean if actions == "mean" else region.successes_stochastic
    return {"actions": actions, "region_kind": region.kind, "region": region.name, **rate(successes, region.episodes)}


def success_rows(
    arrival: Mapping[str, np.ndarray], horizon: int, distance: np.ndarray, subsets: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Success after t steps, as in the CSV file.

    Args:
        arrival: steps until the goal, infinite where it was not reached, for each of :data:`ACTIONS` (E,).
        horizon: T [steps].
        distance: (E,) of the starts to the goal [m].
        subsets: which starts are in each of the task's parts of S^0, {name: (E,) bool}.
    """
    rows = []
    for tenth in range(1, LONGEST * POINTS + 1):
        steps = tenth * horizon // POINTS
        regions = make_regions(distance, subsets, *(arrival[name] <= steps for name in ACTIONS))
        closely = tenth % POINTS == 0 and tenth // POINTS in CLOSELY
        for actions in ACTIONS:
            rows += [
                {"horizons": tenth / POINTS, "steps": steps, **_cells(region, actions)}
                for region in regions
                if closely or region.kind == "all"
            ]
    return rows


def measure(subject: Subject, chosen: HorizonOptions) -> list[dict[str, Any]]:
    """Rows of a policy.

    Raises:
        ConfigError: it cannot be loaded, or its task has no feasible starts.
    """
    begin, loaded = time.monotonic(), subject.load()
    task = loaded.task
    episodes = fewer(chosen.episodes, task.horizon)
    result = play(loaded, task, episodes=episodes, seed=chosen.seed, horizon=LONGEST * task.horizon)
    arrival = {name: np.where(getattr(result, name).success, getattr(result, name).length, np.inf) for name in ACTIONS}
    _, subsets, distance = starts(task, result)
    about = {
        "policy": subject.name,
        "task": loaded.task_name,
        "T": task.horizon,
        "T_s": task.horizon * task.model.opt.timestep,
    }
    rows = [{**about, **row, "seed": chosen.seed} for row in success_rows(arrival, task.horizon, distance, subsets)]
    words = [f"{n} T {np.mean(arrival['stochastic'] <= n * task.horizon):.3f}/"
             f"{np.mean(arrival['mean'] <= n * task.horizon):.3f}" for n in CLOSELY]  # fmt: skip
    print(f"{subject.name}: {episodes} episodes, stochastic/mean after {', '.join(words)} "
          f"({time.monotonic() - begin:.0f} s)", flush=True)  # fmt: skip
    return rows


def _of_all(rows: Sequence[Mapping[str, str]]) -> dict[str, dict[str, list[Mapping[str, str]]]]:
    """policy -> actions -> rows of all episodes."""
    found: dict[str, dict[str, list[Mapping[str, str]]]] = {}
    for row in rows:
        if row["region_kind"] == "all":
            found.setdefault(row["policy"], {}).setdefault(row["actions"], []).append(row)
    return found


def draw(results: Path) -> Path | None:
    """Draws ``horizon.png`` from the CSV file; None where there is none.

    Raises:
        ResultsError: the file is damaged.
    """
    table = results / "horizon.csv"
    policies = _of_all(read(table)) if table.exists() else {}
    if not policies:
        return None
    style.use()
    columns = min(len(policies), 4)
    lines = -(-len(policies) // columns)
    size = (style.WIDTH * max(columns, 2) / 4, 2.75 * lines + 0.55)
    figure = Figure(figsize=size, layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(lines, columns, sharey=True, squeeze=False)).ravel()
    names = {name: rows["mean"][0]["task"] for name, rows in policies.items()}
    tasks = list(style.TASKS)
    order = sorted(policies, key=lambda name: (tasks.index(names[name]) if names[name] in tasks else len(tasks), name))
    for axes, name in zip(all_axes, order):
        both = policies[name]
        for actions in ACTIONS:
            rows = both[actions]
            at = np.array([0.0, *(float(row["horizons"]) for row in rows)]) * float(rows[0]["T_s"])
            success, low, high = (
                np.array([0.0, *(float(row[column]) for row in rows)]) for column in ("success", "low", "high")
            )
            axes.fill_between(at, low, high, color=_COLOURS[actions], alpha=0.13, lw=0)
            axes.plot(at, success, color=_COLOURS[actions], lw=2, label=_LABELS[actions])
        limit = float(both["mean"][0]["T_s"])
        axes.axvline(limit, color="0.35", lw=1, ls="--")
        axes.text(limit, 1.03, f" T = {limit:g} s", fontsize=8.5, color="0.35", va="bottom", ha="center")
        for times in CLOSELY[1:]:
            axes.axvline(times * limit, color="0.75", lw=0.8, ls=":")
        known = names[name] == name
        axes.set_title(style.title(name) if known else f"{style.title(names[name])}: {Path(name).stem}", pad=18)
        axes.set(xlim=(0, LONGEST * limit), ylim=(0, 1.02), xlabel="time in the episode [s]")
        axes.set_xticks([limit * k for k in range(LONGEST + 1)])
    for axes in all_axes[len(policies) :]:
        axes.set_visible(False)
    all_axes[0].set_ylabel(r"success on $\rho_0$ so far")
    style.legend(figure, [(_LABELS[name], _COLOURS[name], "-") for name in ACTIONS])
    commits = sorted({row["commit"] for both in policies.values() for row in both["mean"]})
    episodes = sorted({int(row["episodes"]) for both in policies.values() for row in both["mean"]})
    shown = " or ".join(map(str, episodes))
    words = f"Policies trained for T, given 4 T; {shown} episodes each, band: 95 % Wilson interval; "
    style.note(figure, [f"{words}commit {', '.join(commits)}."])
    return style.save(figure, results / "horizon.png")


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the CSV file for a page."""
    after = [f"{'' if n == 1 else f'{n} '}T" for n in CLOSELY]
    header = "".join(f" {name}, {time} |" for name in ("stochastic", "mean action") for time in after)
    lines = [f"| policy | T | episodes |{header}", "|" + "---|" * (3 + 2 * len(CLOSELY))]
    for name, both in _of_all(rows).items():
        cells = [name, f"{float(both['mean'][0]['T_s']):g} s", both["mean"][0]["episodes"]]
        for actions in ACTIONS:
            found = {float(row["horizons"]): row for row in both[actions]}
            cells += [f"{float(found[n]['success']):.3f}" for n in CLOSELY]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Measures, writes and draws; returns the exit code."""
    chosen = options(HorizonOptions, "experiments.horizon")
    found = subjects(chosen.policy, chosen.run)
    results = folder(chosen.results, chosen.run)
    if not chosen.draw:
        enable_compilation_cache()
        for subject in found:
            about = machine()
            rows = merge(results / "horizon.csv", [{**row, **about} for row in measure(subject, chosen)])
        print(f"\n{markdown(rows)}\n\n{results / 'horizon.csv'}")
    print(draw(results) or f"nothing to draw yet: {results} has no horizon.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
