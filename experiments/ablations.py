"""Ablations: each of our changes to the paper's method taken back (or weakened), one at a time.

    python -m experiments.ablations                                  # trains what is missing, then the table
    python -m experiments.ablations train=no                         # the table and the picture of what there is
    python -m experiments.ablations task=key_insertion change=fixed_std,no_penalty

A row is a change, a task, and three seeds after a fixed number of environment steps, beside the same seeds with all
defaults. Runs lie in ``runs/ablations`` and resume there; what they showed is kept in ``results/ablations/``, the table
in ``results/ablations.csv`` and ``ablations.png``. Rows of earlier defaults are kept apart, and left out.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import style
from experiments.collect import digest
from experiments.plan import GUIDED
from experiments.report import RESULTS, in_one_line, options, read, write_rows
from rcg_jax.config.names import TASKS
from rcg_jax.config.settings import ConfigError, flatten, option
from rcg_jax.runs.settings import task_attributes
from rcg_jax.runs.task_settings import training_config


@dataclass(frozen=True)
class Change:
    """One of our changes, taken back.

    Attributes:
        name: on the command line and in the table.
        settings: what takes it back.
        meaning: for people.
    """

    name: str
    settings: tuple[str, ...]
    meaning: str


#: The first is what the others are compared with.
CHANGES = (
    Change("none", (), "all defaults"),
    Change("no_penalty", ("trpo.saturation_penalty=0",), "means may leave the actuators' range"),
    Change("small_penalty", ("trpo.saturation_penalty=0.05",), "a sixth of the penalty on such means"),
    Change("fixed_std", ("policy.learn_std=false",), "standard deviation stays as it begins"),
    Change("fixed_trust_region", ("trpo.full_step_failures=0",), "full steps also when all is mastered"),
    Change("every_step", ("policy.action_repeat=1",), "a new action in every step of physics"),
    Change("random_starts", ("curriculum.selection=random",), "new starts drawn at random"),
    Change(
        "large_iterations",
        ("rollout.batch_size=50000", "curriculum.num_new=200", "curriculum.num_old=100"),
        "250,000 steps and 300 starts",
    ),
    Change("short_walks", ("curriculum.brownian_horizon_max=50",), "T_B stays at 50"),
    Change("white_noise", ("curriculum.noise=white",), "white action noise"),
    Change(
        "no_outward",
        ("curriculum.min_good=0", "curriculum.outward_share=1", "curriculum.stall_walk=10"),
        "few good starts: as the paper and its code",
    ),
    Change("no_bias", ("curriculum.rho_0_share=0",), "no new starts for being near rho_0"),
    Change("towards_rho_0", ("curriculum.rho_0_share=0.5",), "half of the new starts nearest to draws of rho_0"),
    Change("small_steps", ("trpo.max_kl=0.01",), "trust region of 0.01 nats, as of the other tasks"),
    Change("long_credit", ("trpo.gae_lambda=0.98",), "lambda 0.98, as of the other tasks"),
    Change("small_v", ("baseline.hidden=[32,32]", "baseline.epochs=2"), "V as small and as briefly fitted as there"),
    Change("no_gae", ("trpo.gae_lambda=1",), "returns less V as advantages"),
    Change("whole_batch_fisher", ("trpo.fisher_fraction=1", "trpo.step_scale=1"), "Fisher products over all samples"),
    Change("raw_observations", ("policy.obs_norm_iterations=0",), "observations not normalised"),
)

#: Environment steps of a run [millions].
LENGTHS = {"point_maze": 5, "ring_peg": 5, "key_insertion": 10, "ant_maze": 4}


@dataclass(frozen=True)
class AblationOptions:
    """Settings of ``python -m experiments.ablations``."""

    task: str = option("point_maze,ring_peg", "tasks, separated by commas")
    change: str = option("all", "changes, separated by commas: " + ", ".join(each.name for each in CHANGES))
    seed: str = option("0,1,2", "seeds, separated by commas")
    train: str = option("yes", "whether to train what is missing", choices=("yes", "no"))
    run_dir: str = option("runs/ablations", "folder of the runs")
    results: str = option(str(RESULTS), "folder of the CSV files and of the picture")


def _some(field: str, text: str, known: Iterable[str]) -> list[str]:
    names = list(known)
    if text == "all":
        return names
    for name in text.split(","):
        if name not in names:
            raise ConfigError(f"{field}={text}: {name} is unknown; all, or some of {', '.join(names)}")
    return text.split(",")


def _settings(task: str, change: Change) -> list[str]:
    """Those of a change on a task. The ring's and the ant's ablations are all of runs that S^0 guides."""
    return [*([GUIDED] if task in ("ring_peg", "ant_maze") else []), *change.settings]


def _iterations(task: str, change: Change) -> int:
    """Curriculum iterations of ``LENGTHS`` steps; a change of the batch size changes them."""
    per_iteration = 400_000 if task == "ant_maze" else 100_000
    batch = [int(word.partition("=")[2]) for word in change.settings if word.startswith("rollout.batch_size=")]
    return LENGTHS[task] * 1_000_000 // (5 * batch[0] if batch else per_iteration)


def train(chosen: AblationOptions, tasks: Sequence[str], changes: Sequence[Change]) -> bool:
    """Trains what is missing; False if something failed."""
    ok = True
    jobs = [(task, change) for task in tasks for change in changes if is_change(change, task)]
    for k, (task, change) in enumerate(jobs):
        iterations = _iterations(task, change)
        settings = [*_settings(task, change), f"iterations={iterations}", f"eval_every={max(1, iterations // 5)}"]
        settings.append("write_report=false")
        words = [f"task={task}", "method=reverse", "reward=sparse", "preset=default", f"seed={chosen.seed}"]
        words += ["together=yes", f"settings={' '.join(settings)}", f"run_dir={chosen.run_dir}/{change.name}"]
        words.append(f"out={Path(chosen.results) / 'ablations'}")
        print(f"[{k + 1}/{len(jobs)}] {task}: {change.name}", flush=True)
        ok &= subprocess.run([sys.executable, "-m", "experiments.reproduce", *words]).returncode == 0
    return ok


@cache
def _digest(change: Change, task: str) -> str:
    """What a change's runs on a task are known by in the CSV files, with the present defaults for the rest."""
    values = {name: value for name, _, value in flatten(training_config([f"task={task}", *_settings(task, change)]))}
    return digest(values | task_attributes(task))


def is_change(change: Change, task: str) -> bool:
    """Whether it changes anything on a task: some of ours are on some tasks only."""
    return change is CHANGES[0] or _digest(change, task) != _digest(CHANGES[0], task)


def tabulate(results: Path) -> list[dict[str, Any]]:
    """A row for each task and change that there are runs of with the present defaults."""
    path = results / "ablations" / "runs.csv"
    runs = read(path) if path.exists() else []
    known: dict[tuple[str, str], Change] = {}
    for task in TASKS:
        for one in CHANGES:  # the first of those that come to the same
            known.setdefault((task, _digest(one, task)), one)
    found: dict[tuple[str, str], dict[str, dict[str, str]]] = {}
    for run in runs:
        change = known.get((run["task"], run["config"]))
        if change and run["success_stochastic"] and int(run["env_steps"]) == LENGTHS[run["task"]] * 1_000_000:
            seeds = found.setdefault((run["task"], change.name), {})
            # What is a default now may have been run as a change before, and the other way round: the later run counts.
            if run["seed"] not in seeds or run["ended"] > seeds[run["seed"]]["ended"]:
                seeds[run["seed"]] = run
    rows = []
    order = [each.name for each in CHANGES]
    for task, name in sorted(found, key=lambda key: (TASKS.index(key[0]), order.index(key[1]))):
        mine = sorted(found[task, name].values(), key=lambda run: int(run["seed"]))
        values, means = (np.array([float(run[c]) for run in mine]) for c in ("success_stochastic", "success_mean"))
        base = [float(run["success_stochastic"]) for run in found.get((task, "none"), {}).values()]
        change = CHANGES[order.index(name)]
        rows.append(
            {
                "task": task,
                "change": name,
                "settings": " ".join(change.settings),
                "seeds": len(mine),
                "env_steps": mine[0]["env_steps"],
                "success": round(float(values.mean()), 4),
                "spread": round(float(values.std(ddof=1)), 4) if len(mine) > 1 else "",
                "worst": round(float(values.min()), 4),
                "best": round(float(values.max()), 4),
                "mean_policy": round(float(means.mean()), 4),
                "difference": round(float(values.mean() - np.mean(base)), 4) if base else "",
                "each": " ".join(f"{value:.4f}" for value in values),
                "config": _digest(change, task),
                "commit": "+".join(sorted({run["commit"] for run in mine})),
                "command": f"python -m experiments.ablations task={task} change={name}",
            }
        )
    return rows


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """A dot for every seed, a bar at their mean, a line at the defaults."""
    style.use()
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    shown = [change for change in CHANGES if any(row["change"] == change.name for row in rows)]
    figure = Figure(figsize=(style.WIDTH, 0.36 * len(shown) + 1.3), layout="constrained")
    for axes, task in zip(np.ravel(figure.subplots(1, len(tasks), sharey=True)), tasks):
        mine = {row["change"]: row for row in rows if row["task"] == task}
        for y, change in enumerate(shown):
            if (row := mine.get(change.name)) is None:
                continue
            colour = "black" if change.name == "none" else style.colour("reverse")
            axes.plot(
                [float(value) for value in row["each"].split()], [y] * row["seeds"], "o", color=colour, ms=5, alpha=0.6
            )
            axes.plot([row["success"]] * 2, [y - 0.3, y + 0.3], color=colour, lw=2.5)
            if change.name == "none":
                axes.axvline(row["success"], color="black", lw=0.8, ls=":")
        steps = int(next(iter(mine.values()))["env_steps"]) / 1e6
        axes.set_title(f"{task}\n{steps:.0f} M steps")
        axes.set_xlabel("success on rho_0")
        axes.set_xlim(-0.04, 1.04)
        axes.set_xticks((0, 0.5, 1))
    first = figure.axes[0]
    first.set_yticks(range(len(shown)), [change.meaning for change in shown])
    first.invert_yaxis()
    figure.savefig(path)


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """For a page; rows as they are made, or as they are read."""
    meaning = {change.name: change.meaning for change in CHANGES}
    lines = ["| task | taken back | seeds | M steps | success, mean (each) | difference |", "|" + "---|" * 6]
    for row in rows:
        each = ", ".join(f"{float(value):.3f}" for value in row["each"].split())
        difference = "" if row["change"] == "none" or row["difference"] == "" else f"{float(row['difference']):+.3f}"
        name = row["change"] if row["change"] == "none" else f"{row['change']}: {meaning[row['change']]}"
        steps, success = int(row["env_steps"]) / 1e6, float(row["success"])
        lines.append(
            f"| {row['task']} | {name} | {row['seeds']} | {steps:.0f} | {success:.3f} ({each}) | {difference} |"
        )
    return "\n".join(lines)


@in_one_line
def main() -> int:
    """Trains, writes, prints."""
    chosen = options(AblationOptions, "experiments.ablations")
    tasks = _some("task", chosen.task, TASKS)
    names = _some("change", chosen.change, [each.name for each in CHANGES])
    ok = chosen.train == "no" or train(chosen, tasks, [each for each in CHANGES if each.name in names])
    results = Path(chosen.results)
    rows = tabulate(results)
    if not rows:
        print(f"{results}: no ablations with the present defaults yet")
        return 1
    write_rows(results / "ablations.csv", rows)
    draw(rows, results / "ablations.png")
    print(f"{markdown(rows)}\n\n{results / 'ablations.csv'}, {results / 'ablations.png'}")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
