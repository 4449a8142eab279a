"""What the commands on runs, policies and starts refuse: in one line, before anything is computed or written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rcg_jax import export, feasible, render
from rcg_jax.evaluate import __main__ as evaluate
from rcg_jax.report import __main__ as report


@pytest.mark.parametrize(
    ("main", "words", "says"),
    [
        (evaluate.main, "", "run=DIR, or policy=NAME is missing"),
        (evaluate.main, "run=RUN policy=point_maze", "run=... and policy=...: one of them"),
        (evaluate.main, "policy=point_maze iteration=2", "iteration=2: only with run=..."),
        (evaluate.main, "policy=point_maze task=ring_peg engine=native", "of length 4, task=ring_peg has 17"),
        (evaluate.main, "run=RUN task=tiny", "task=tiny: only with policy=..."),
        (evaluate.main, "run=RUN out=regions.txt", "out=regions.txt: must end in .csv"),
        (evaluate.main, "run=RUN out=/nowhere/a.csv", "no such folder /nowhere"),
        (evaluate.main, "run=/nowhere", "run=/nowhere: no such folder"),
        (evaluate.main, "episodes", "episodes: cannot be read; write name=value"),
        (evaluate.main, "episode=3", "episode=3: unknown setting episode; did you mean episodes?"),
        (evaluate.main, "run=RUN episodes=0", "episodes=0: must be an integer >= 1"),
        (evaluate.main, "run=RUN iteration=last", "iteration=last: must be newest or a number >= 1"),
        (evaluate.main, "run=RUN iteration=7", "has checkpoints of 2, 3"),
        (evaluate.main, "run=RUN/checkpoints", "no config.yaml there"),
        (render.main, "", "run=DIR, or policy=NAME is missing"),
        (render.main, "run=RUN policy=point_maze", "one of them, not both"),
        (render.main, "run=RUN task=tiny", "task=tiny: only with policy=..."),
        (render.main, "run=RUN width=201", "width=201: must be even"),
        (render.main, "run=RUN fps=0", "fps=0: must be an integer >= 1 and <= 100"),
        (render.main, "run=RUN out=film.gif", "out=film.gif: must end in .mp4"),
        (export.main, "", "run=DIR, or policy=NAME, or task=NAME is missing"),
        (export.main, "run=RUN out=a.txt", "out=a.txt: must end in .npz"),
        (export.main, "run=RUN episodes=-1", "episodes=-1: must be"),
        (export.main, "task=tiny", "out=FILE.xml is missing"),
        (export.main, "task=nothing out=a.xml", "task=nothing: must be one of"),
        (report.main, "run=/nowhere run=/else", "run=/nowhere: no run there"),
        (report.main, "out=x.html", "run=DIR is missing"),
        (report.main, "run=RUN out=x.pdf", "out=x.pdf: must end in .html"),
        (report.main, "run=RUN video=2", "did you mean videos?"),
        (feasible.main, "task=ring", "task=ring: must be one of point_maze, ant_maze, ring_peg"),
        (feasible.main, "noise=pink", "noise=pink: must be one of white, integrated"),
        (feasible.main, "grid=0", "grid=0: must be a number > 0"),
        (feasible.main, "num_walks=1.5", "num_walks=1.5: must be an integer"),
        (feasible.main, "walk_lenght=5", "did you mean walk_length?"),
        (feasible.main, "out=starts.txt", "out=starts.txt: must end in .npz"),
        (feasible.main, "out=/dev/null/starts.npz", "/dev/null is no folder that can be written to"),
    ],
)
def test_refused_in_one_line(
    main: Callable[[list[str]], int], words: str, says: str, saved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(saved.rglob("*"))
    assert main(words.replace("RUN", str(saved)).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
    assert sorted(saved.rglob("*")) == before
