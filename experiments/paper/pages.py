"""Puts the tables of the committed CSV files into the pages that show them.

    python -m experiments.paper.pages                         # docs/results.md and README.md
    python -m experiments.paper.pages pages=docs/results.md

In a page a table stands between two comments, which name it; what is between them is replaced:

    <!-- table: results -->
    <!-- end -->

Tables whose CSV file does not exist, and pages without such comments, stay as they are.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.common import RESULTS, ResultsError, in_one_line, options, read
from experiments.paper import bootstrapping, results_table
from experiments.race import report as race
from rcg_jax.config import option


def robustness_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Success of the stochastic policies: a row for each condition, a column for each task."""
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        name = "unchanged" if row["perturbed"] == "none" else f"{row['perturbed']} {float(row['level']):g}"
        cells.setdefault(name, {})[row["task"]] = f"{float(row['success_stochastic']):.3f}"
    lines = [f"| | {' | '.join(tasks)} |", "|" + "---|" * (1 + len(tasks))]
    return "\n".join(
        [*lines, *(f"| {name} | {' | '.join(of.get(t, '-') for t in tasks)} |" for name, of in cells.items())]
    )


#: Name -> (CSV file, how its rows are shown).
TABLES: dict[str, tuple[str, Callable[[Sequence[Mapping[str, str]]], str]]] = {
    "results": ("results.csv", results_table.markdown),
    "bootstrapping": ("bootstrapping.csv", bootstrapping.table),
    "race": ("race.csv", race.table),
    "robustness": ("robustness.csv", robustness_table),
    "headline": ("results.csv", results_table.headline),
}

_BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
#: Where the pages are.
ROOT = Path(__file__).parents[2]
#: Those of this project.
PAGES = ("docs/results.md", "docs/paper.md", "docs/race.md", "docs/robustness.md", "README.md")


@dataclass(frozen=True)
class PageOptions:
    """Settings of ``python -m experiments.paper.pages``."""

    pages: str = option(",".join(PAGES), "Markdown files, separated by commas")
    results: str = option(str(RESULTS), "folder of the CSV files")


def renewed(text: str, results: Path) -> str:
    """A page with the tables of the CSV files.

    Raises:
        ResultsError: a table that there is not, or a damaged CSV file.
    """

    def table(match: re.Match[str]) -> str:
        begin, name, end = match.groups()
        if name not in TABLES:
            raise ResultsError(f"table: {name}: must be one of {', '.join(TABLES)}")
        path, show = results / TABLES[name][0], TABLES[name][1]
        if not path.exists():
            return match.group(0)
        return f"{begin}\n{show(read(path))}\n\n{end}"

    return _BLOCK.sub(table, text)


def renew(path: Path, results: Path) -> bool:
    """Renews a page; returns whether it changed.

    Raises:
        ResultsError: a table that there is not, or a damaged CSV file.
        OSError: the page cannot be read or written.
    """
    old = path.read_text()
    new = renewed(old, results)
    if new != old:
        path.write_text(new)
    return new != old


@in_one_line
def main() -> int:
    """Renews the pages."""
    chosen = options(PageOptions, "experiments.paper.pages")
    for name in chosen.pages.split(","):
        path = ROOT / name
        if not path.is_file():
            print(f"error: pages={chosen.pages}: {path}: no such file", file=sys.stderr)
            return 2
        print(f"{name}: {'renewed' if renew(path, Path(chosen.results)) else 'as it was'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
