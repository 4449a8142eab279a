"""Curves of several seeds, read from the committed CSV files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from scipy import stats

from experiments.common import RESULTS, ResultsError, read, require
from experiments.paper import style
from experiments.paper.collect import present
from experiments.paper.plan import CURVES, GUIDED, SEEDS, Curve

#: The published curves, read off the authors' figures (mean within 0.01, band within 0.02).
PAPER_CURVES = Path(__file__).parent / "published_curves.csv"


@dataclass(frozen=True)
class Series:
    """Rows of one seed, as columns of equal length; empty cells are NaN."""

    columns: dict[str, np.ndarray]

    @property
    def iterations(self) -> int:
        """The last one."""
        return int(self.columns["iteration"][-1])

    @property
    def env_steps(self) -> int:
        """How far it got."""
        return int(self.columns["env_steps"][-1])

    def of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(environment steps, values) where a column has them."""
        values = self.columns[name]
        there = ~np.isnan(values)
        return self.columns["env_steps"][there], values[there]


@dataclass(frozen=True)
class Band:
    """A column over environment steps: the seeds that got furthest side by side, and all others.

    Attributes:
        steps: (K,) environment steps that they all have reached.
        values: (S, K), interpolated between their own rows.
        shorter: (steps, values) of seeds that ended earlier.
    """

    steps: np.ndarray
    values: np.ndarray
    shorter: list[tuple[np.ndarray, np.ndarray]]

    @property
    def mean(self) -> np.ndarray:
        """(K,) over the seeds."""
        return self.values.mean(axis=0)

    @property
    def std(self) -> np.ndarray:
        """(K,) standard deviation of the seeds, zero for a single one."""
        return self.values.std(axis=0, ddof=1) if len(self.values) > 1 else np.zeros(len(self.steps))


@dataclass(frozen=True)
class Seeds:
    """All seeds of a curve.

    Attributes:
        curve: which.
        settings: in which these runs differ from the present defaults of their preset, guidance apart.
        config: digest of all their settings.
        runs: by seed.
        others: runs of the same curve with other settings, which are not shown.
    """

    curve: Curve
    settings: str
    config: str
    runs: dict[int, Series]
    others: int = 0

    @property
    def of_today(self) -> bool:
        """Whether these runs have the present defaults."""
        return not self.settings and self.config == present(self.curve.preset, self.curve.task, self.curve.guided)

    @property
    def furthest(self) -> dict[int, Series]:
        """The seeds that have the most iterations of all; the others are unfinished."""
        most = max(run.iterations for run in self.runs.values())
        return {seed: run for seed, run in sorted(self.runs.items()) if run.iterations == most}

    def band(self, name: str) -> Band:
        """A column of all seeds."""
        lines = {seed: run.of(name) for seed, run in sorted(self.runs.items())}
        whole = [line for seed, line in lines.items() if seed in self.furthest and len(line[0])]
        shorter = [line for seed, line in lines.items() if seed not in self.furthest and len(line[0])]
        if not whole:
            return Band(np.zeros(0), np.zeros((0, 0)), shorter)
        first, last = max(steps[0] for steps, _ in whole), min(steps[-1] for steps, _ in whole)
        grid = np.unique(np.concatenate([steps for steps, _ in whole]))
        grid = grid[(grid >= first) & (grid <= last)]
        values = np.array([np.interp(grid, steps, values) for steps, values in whole])
        return Band(grid, values, shorter)

    @property
    def missing(self) -> list[int]:
        """Seeds of the paper's five that there are none of."""
        return [seed for seed in SEEDS if seed not in self.runs]


def _number(cell: str) -> float:
    return float(cell) if cell else math.nan


def load(task: str, results: Path = RESULTS) -> list[Seeds]:
    """All curves of a task; of one with runs of several settings, those of the present defaults, else the newest.

    Raises:
        ResultsError: a CSV file is damaged, or another program's.
    """
    path = results / f"curves_{task}.csv"
    rows = read(path) if path.exists() else []
    require(path, rows, [*_KEY, "iteration", "env_steps", "success_stochastic"])
    found: dict[tuple[Curve, str, str], dict[int, list[dict[str, str]]]] = {}
    for row in rows:
        key = group({**row, "task": task})
        try:
            seed = int(row["seed"])
        except ValueError:
            raise ResultsError(f"{path}: seed={row['seed']}: must be a number") from None
        found.setdefault(key, {}).setdefault(seed, []).append(row)
    ended: dict[tuple[Curve, str, str], str] = {}
    for row in about(results):
        ended[group(row)] = max(ended.get(group(row), ""), row.get("ended", ""))
    best: dict[Curve, Seeds] = {}
    for curve in sorted({key[0] for key in found}):
        every = [
            Seeds(curve, key[1], key[2], {seed: _series(path, rows) for seed, rows in runs.items()})
            for key, runs in found.items()
            if key[0] == curve
        ]
        first = max(
            every, key=lambda s: (s.of_today, ended.get((s.curve, s.settings, s.config), ""), len(s.runs), s.config)
        )
        best[curve] = replace(first, others=sum(len(each.runs) for each in every) - len(first.runs))
    return list(best.values())


def about(results: Path) -> list[dict[str, str]]:
    """Rows of ``runs.csv``; none where there is none.

    Raises:
        ResultsError: it is damaged, or another program's.
    """
    path = results / "runs.csv"
    rows = read(path) if path.exists() else []
    require(path, rows, ["task", *_KEY, "iterations", "planned", "seconds", "engine", "device", "commit"])
    return rows


def group(row: dict[str, str]) -> tuple[Curve, str, str]:
    """Which curve, settings and digest a row of ``runs.csv`` is of."""
    words = row["settings"].split()
    curve = Curve(row["task"], row["method"], row["reward"], row["preset"], guided=GUIDED in words)
    return curve, " ".join(word for word in words if word != GUIDED), row.get("config", "")


#: Columns by which runs are told apart; older files have no digest.
_KEY = ("method", "reward", "preset", "seed", "settings")


def _series(path: Path, rows: Sequence[dict[str, str]]) -> Series:
    names = [name for name in rows[0] if name not in (*_KEY, "config")]
    try:
        return Series({name: np.array([_number(row[name]) for row in rows]) for name in names})
    except ValueError as error:
        raise ResultsError(f"{path}: {error}") from None


def find(curves: Iterable[Seeds], method: str, *, reward: str = "sparse", preset: str = "default") -> Seeds | None:
    """The curve of these that nothing guides, if there is one."""
    for each in curves:
        if each.curve == Curve(each.curve.task, method, reward, preset):
            return each
    return None


def plot(axes: Axes, seeds: Seeds, name: str, line: str = "-") -> int:
    """A column of a curve: its mean with a band of one standard deviation, and every seed thinly.

    Args:
        axes: where.
        seeds: the curve.
        name: the column.
        line: line style.

    Returns:
        Number of seeds in the mean; 0: nothing was drawn but what is shorter.
    """
    band, colour = seeds.band(name), style.colour(seeds.curve.method)
    for values in band.values if len(band.values) > 1 else []:
        axes.plot(band.steps / 1e6, values, line, color=colour, lw=0.7, alpha=0.35)
    for steps, values in band.shorter:
        axes.plot(steps / 1e6, values, line, color=colour, lw=0.7, alpha=0.35)
    if not len(band.steps):
        return 0
    if len(band.values) > 1:
        low, high = np.clip(band.mean - band.std, 0, 1), np.clip(band.mean + band.std, 0, 1)
        axes.fill_between(band.steps / 1e6, low, high, color=colour, alpha=0.11, lw=0)
    marker = "o" if len(band.steps) == 1 else ""
    # A single seed is no mean.
    width = 2.2 if len(band.values) > 1 else 1.2
    axes.plot(band.steps / 1e6, band.mean, line, color=colour, lw=width, marker=marker, ms=4)
    return len(band.values)


def interval(values: np.ndarray) -> tuple[float, float]:
    """95 % Student interval of the mean of (S,) seeds, within [0, 1]; NaN for a single one."""
    if len(values) < 2:
        return math.nan, math.nan
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return max(0.0, float(values.mean() - half)), min(1.0, float(values.mean() + half))


def sources(curves: Iterable[Seeds], results: Path = RESULTS) -> list[str]:
    """Sentences about the runs behind a figure: engines, settings, evaluation, commits."""
    curves = [each for each in curves if each]
    if not curves:
        return []
    chosen = {(each.curve, each.settings, each.config, str(seed)) for each in curves for seed in each.runs}
    rows = [row for row in about(results) if (*group(row), row["seed"]) in chosen]

    def each(name: str, what: str) -> str:
        """The values that there are, and of how many runs there is none."""
        known = sorted({row[name] for row in rows} - {""})
        without = sum(not row[name] for row in rows)
        lacking = f"{what} of {without} of them not recorded" if known else f"{what} not recorded"
        return ", ".join([*known, *([lacking] if without or not known else [])])

    finished = sum(int(row["iterations"]) >= int(row["planned"]) for row in rows)
    presets = ", ".join(sorted({f"preset={each.curve.preset}" for each in curves}))
    settings = sorted({f"{each.curve.task}: {each.settings}" for each in curves if each.settings})
    text = (
        f"{len(rows)} runs" + (f", {len(rows) - finished} of them unfinished" if finished < len(rows) else "") + "; "
        f"engine {each('engine', 'engine')}; {presets}{'; ' * bool(settings)}{'; '.join(settings)}; "
        f"commit {each('commit', 'commit')}; {each('device', 'machine')}."
    )
    earlier = [
        f"{each.curve} ({each.config or 'no digest'})" for each in curves if not each.settings and not each.of_today
    ]
    if earlier:
        text += f" Made with other defaults than today's: {', '.join(earlier)}."
    if others := [f"{each.curve} {each.others}" for each in curves if each.others]:
        text += f" Runs with other settings, not drawn: {', '.join(others)}."
    short = [f"{each.curve} {len(each.furthest)}" for each in curves if len(each.furthest) < len(SEEDS)]
    return [text, *([f"Fewer than {len(SEEDS)} seeds in the mean: {', '.join(short)}."] if short else [])]


def missing(needed: Iterable[Curve], curves: Iterable[Seeds], budget: str = "cpu") -> list[str]:
    """One line per task that lacks seeds of ``needed`` curves: what is missing, and which command makes it."""
    have = {each.curve: each for each in curves}
    by_task: dict[str, list[str]] = {}
    for curve in needed:
        lacking = have[curve].missing if curve in have else list(SEEDS)
        if lacking:
            by_task.setdefault(curve.task, []).append(f"{str(curve).split(' ', 1)[1]} ({seeds_text(lacking)})")
    return [f"{task} lacks {', '.join(what)}: {command(task, budget)}" for task, what in by_task.items()]


def seeds_text(seeds: Sequence[int]) -> str:
    """Which of the paper's seeds, in words."""
    return "all seeds" if len(seeds) == len(SEEDS) else "seeds " + ",".join(map(str, seeds))


def command(task: str, budget: str = "cpu") -> str:
    """What makes the runs of a task."""
    return f'make reproduce BUDGET={budget} ARGS="task={task}"'


def needed(where: Callable[[Curve], bool]) -> list[Curve]:
    """Curves that a figure shows."""
    return [curve for curve in CURVES if where(curve)]
