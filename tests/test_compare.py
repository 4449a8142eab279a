"""The comparison of methods: what is refused, and the numbers it draws from the files of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments import compare
from rcg_jax.config import Config
from rcg_jax.metrics import CsvLog
from rcg_jax.run_folder import RunFolder

FINALS = {"reverse": (0.8, 1.0), "uniform": (0.1, 0.9)}


@pytest.fixture
def args(tmp_path: Path) -> dict[str, Any]:
    """Two methods, two seeds, three iterations, evaluated after the first and the last."""
    for method, finals in FINALS.items():
        for seed, final in enumerate(finals):
            folder = RunFolder(Config(method=method, task="point_maze", run_dir=str(tmp_path)), seed)
            folder.path.mkdir(parents=True)
            folder.write_config()
            metrics = CsvLog(folder.path / "metrics.csv", ["iteration", "proposal_steps"], keep=0)
            for i in (1, 2, 3):
                metrics.append({"iteration": i, "proposal_steps": 100 * (seed + 1)})
            columns = ["iteration", "env_steps", "episodes", "success_stochastic"]
            evaluations = CsvLog(folder.path / "eval.csv", columns, keep=0)
            evaluations.append({"iteration": 1, "env_steps": 10, "episodes": 500, "success_stochastic": 0.0})
            # The last iteration is evaluated twice; the larger number of episodes counts.
            evaluations.append({"iteration": 3, "env_steps": 30, "episodes": 500, "success_stochastic": 0.0})
            evaluations.append({"iteration": 3, "env_steps": 30, "episodes": 2000, "success_stochastic": final})
    return {**compare.DEFAULTS, "run_dir": str(tmp_path), "out": str(tmp_path)}


def test_summary_and_picture(args: dict[str, Any], tmp_path: Path) -> None:
    rows = compare.collect(tmp_path, "point_maze", "commit")
    found = {row["method"]: row for row in compare.summary(args, rows, list(FINALS))}
    assert found["reverse"]["success_mean"] == pytest.approx(0.9)
    assert found["uniform"]["success_std"] == pytest.approx(0.4)
    assert found["uniform"]["success_worst"] == pytest.approx(0.1)
    assert found["uniform"]["success_best"] == pytest.approx(0.9)
    assert found["reverse"]["seeds"] == 2
    assert found["reverse"]["env_steps"] == 30
    assert found["reverse"]["proposal_steps"] == 450
    compare.draw(rows, "point_maze", list(FINALS), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_what_a_task_does_not_support_is_refused_before_the_first_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["compare", "task=ring_peg", "methods=uniform,oracle", "seeds=0"])
    monkeypatch.setattr(compare, "train", lambda *_: pytest.fail("a run was begun"))
    with pytest.raises(SystemExit, match=r"method=oracle: task=ring_peg cannot .* choose with methods="):
        compare.main()
    monkeypatch.setattr("sys.argv", ["compare", "methods=reverse,nope"])
    with pytest.raises(SystemExit, match="methods=reverse,nope: nope is none of reverse, all_starts"):
        compare.main()
