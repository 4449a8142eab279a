"""All figures and tables of the paper from the committed CSV files, in less than two minutes.

    python -m experiments.paper.figures                      # all
    python -m experiments.paper.figures only=fig2,fig5       # some

Nothing is trained. A figure whose runs are missing draws what there is, and one line says which command makes the rest.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.common import RESULTS, options, read
from rcg_jax.config.settings import option


@dataclass(frozen=True)
class FigureOptions:
    """Settings of ``python -m experiments.paper.figures``."""

    only: str = option("all", "figures, separated by commas")
    results: str = option(str(RESULTS), "folder of the CSV files and of the pictures")


#: Files written, and what is missing.
Drawn = tuple[Sequence[Path | None], list[str]]


def _tasks(results: Path) -> Drawn:
    from experiments.paper import task_pictures
    from rcg_jax.config.names import TASKS
    from rcg_jax.report.scene import RenderError

    try:
        task_pictures.draw(TASKS, results)
    except RenderError as error:
        return [], [f"this machine cannot draw tasks: {error}"]
    return [results / "tasks.png", *(results / f"starts_{task}.png" for task in TASKS)], []


def _learning(results: Path) -> Drawn:
    from experiments.paper import learning_curves

    path, lacking = learning_curves.draw(results)
    paths: list[Path | None] = [path]
    # The paper's own values take days on a CPU: drawn when somebody has run them.
    if any(row["preset"] == "paper" for table in results.glob("curves_*.csv") for row in read(table)):
        path, more = learning_curves.draw(results, "paper")
        paths, lacking = [*paths, path], [*lacking, *more]
    return paths, lacking


def _good_starts(results: Path) -> Drawn:
    from experiments.paper import good_starts

    path, lacking = good_starts.draw(results)
    return [path], lacking


def _distance(results: Path) -> Drawn:
    from experiments.paper import distance_reward

    path, lacking = distance_reward.draw(results)
    return [path], lacking


def _bootstrapping(results: Path) -> Drawn:
    from experiments.paper import bootstrapping

    path = bootstrapping.draw(results)
    return [path], [] if path else ["bootstrapping.csv is not there"]


def _race(results: Path) -> Drawn:
    from experiments.race import report

    path = report.draw(results)
    return ([path], []) if path else ([], ["no race yet: make race"])


def _table(results: Path) -> Drawn:
    from experiments.paper import results_table

    rows = results_table.write(results)
    if not rows:
        return [], ["no runs yet: make reproduce BUDGET=cpu"]
    print(results_table.markdown(rows))
    return [results / "results.csv"], []


def _page(results: Path) -> Drawn:
    if results.resolve() != RESULTS.resolve():
        return [], []  # the pages are about the committed files
    from experiments.paper import pages as results_page

    paths = [results_page.ROOT / name for name in results_page.PAGES]
    return [path for path in paths if results_page.renew(path, results)], []


#: What there is: name -> (what it shows, how it is drawn).
FIGURES: dict[str, tuple[str, Callable[[Path], Drawn]]] = {
    "table": ("success at the end of every curve", _table),
    "fig2": ("learning curves", _learning),
    "fig3": ("share of good starts", _good_starts),
    "fig5": ("distance penalty", _distance),
    "bootstrapping": ("what the value function is bootstrapped from", _bootstrapping),
    "race": ("success over minutes, beside what others would run", _race),
    "page": ("the tables of README.md and docs/", _page),
    "tasks": ("figures 1 and 4: tasks, and their feasible starts", _tasks),
}


def main() -> int:
    """Draws; returns the exit code: 1 if a figure could not be drawn for another reason than missing runs."""
    chosen = options(FigureOptions, "experiments.paper.figures")
    names = list(FIGURES) if chosen.only == "all" else chosen.only.split(",")
    for name in names:
        if name not in FIGURES:
            print(f"error: only={chosen.only}: {name} is none of {', '.join(FIGURES)}", file=sys.stderr)
            return 2
    if not Path(chosen.results).is_dir():
        print(f"error: results={chosen.results}: no such folder", file=sys.stderr)
        return 2
    begin, lacking, failed = time.monotonic(), [], 0
    for k, name in enumerate(names):
        what, draw = FIGURES[name]
        print(f"[{k + 1}/{len(names)}] {name}: {what}", flush=True)
        try:
            paths, lines = draw(Path(chosen.results))
        except (OSError, ValueError, KeyError) as error:
            failed += 1
            print(f"  not drawn: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
            continue
        print("".join(f"  {path}\n" for path in paths if path), end="", flush=True)
        lacking += [f"{name}: {line}" for line in lines]
    print(f"{time.monotonic() - begin:.0f} s")
    if lacking:
        print("missing; what there is was drawn:\n" + "\n".join(f"  {line}" for line in lacking))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
