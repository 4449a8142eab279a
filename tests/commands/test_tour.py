"""The notebook docs/tour.ipynb runs as it stands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import notebook

TOUR = Path(__file__).parents[2] / "docs" / "tour.ipynb"


@pytest.mark.slow
def test_it_runs_and_the_policy_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = notebook.execute(json.loads(TOUR.read_text())["cells"])
    assert names["evaluations"]["success_stochastic"][-1] > 0.9
    assert names["run"].path == Path("runs/point_maze/reverse/seed2")


def test_it_is_small_and_has_its_outputs() -> None:
    assert TOUR.stat().st_size < 600_000
    code = [cell for cell in json.loads(TOUR.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
