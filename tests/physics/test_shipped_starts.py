"""The feasible starts that come with each task are what their card says: collision-free, at rest, spread out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import pytest

from rcg_jax import feasible
from rcg_jax.curriculum.feasible import cells, clearance, limit_excess, make_settle
from rcg_jax.io.starts_file import load_states, starts_hash
from rcg_jax.tasks import TASKS, Task, make_task


@dataclass(frozen=True)
class Shipped:
    """A task, its starts, their card."""

    task: Task
    qpos: np.ndarray
    card: dict[str, Any]


@pytest.fixture(scope="module", params=TASKS)
def shipped(request: pytest.FixtureRequest) -> Shipped:
    task = make_task(request.param, "native")
    card = json.loads(task.feasible_file.with_suffix(".json").read_text())
    return Shipped(task, load_states(task.feasible_file)[0], card)


def test_they_are_the_ones_of_the_card(shipped: Shipped) -> None:
    file, card = shipped.task.feasible_file, shipped.card
    assert file.stat().st_size < 1_500_000
    now = feasible.describe(shipped.task, shipped.qpos)
    assert starts_hash(file) == card["sha256"] == now["sha256"]
    assert card["count"] == now["count"] == len(shipped.qpos) == sum(card["distance_histogram"]["counts"])
    # Recomputed in float32: a state on the edge of a bin may fall to its other side on another machine.
    for name, part in card["composition"].items():
        assert now["composition"][name]["count"] == pytest.approx(part["count"], abs=2)
        assert part["share"] == pytest.approx(part["count"] / card["count"], abs=1e-4)
    assert now["mean_distance_m"] == pytest.approx(card["mean_distance_m"], abs=1e-3)
    np.testing.assert_allclose(now["distance_histogram"]["counts"], card["distance_histogram"]["counts"], atol=2)


def test_the_task_has_them_at_rest(shipped: Shipped) -> None:
    task, starts = shipped.task, shipped.task.feasible_starts()
    np.testing.assert_array_equal(starts.qpos, shipped.qpos)
    assert starts.qvel.shape == (len(shipped.qpos), task.model.nv)
    assert not starts.qvel.any()
    assert starts.valid.all()
    assert jax.jit(lambda s: jax.vmap(task.is_feasible)(task.snapshot(task.reset(s))))(starts).all()


def test_they_are_thinned_and_sound(shipped: Shipped) -> None:
    """Of the maze of the point they are drawn exactly; elsewhere found by a search that checks them."""
    task, settings = shipped.task, shipped.card["settings"]
    if shipped.card["search"] == {"exact_sampler": True}:
        drawn = task.sample_feasible(jax.random.key(settings["seed"]), len(shipped.qpos))
        np.testing.assert_allclose(drawn.qpos, shipped.qpos, atol=1e-5)
        return
    places = np.asarray(task.grid_coordinates(shipped.qpos))
    assert len(np.unique(cells(places, settings["grid"]), axis=0)) == len(shipped.qpos)
    assert clearance(task.model, shipped.qpos[::4]).min() >= -settings["max_depth"] >= -0.01
    assert limit_excess(task.model, shipped.qpos).max() <= settings["max_excess"] <= 0.05


@pytest.mark.slow
def test_they_stay_under_zero_action(shipped: Shipped) -> None:
    settings, exact = shipped.card["settings"], shipped.task.name == "point_maze"
    stays, drift = make_settle(shipped.task, 500 if exact else settings["settle_steps"])(
        shipped.qpos[:: max(1, len(shipped.qpos) // 4_000)]
    )
    assert stays.all()
    assert drift.max() <= (1e-3 if exact else settings["max_drift"] + 1e-3)


def share(shipped: Shipped, name: str) -> float:
    return float(shipped.card["composition"][name]["share"])


def test_they_are_no_easier_than_the_papers(shipped: Shipped) -> None:
    name, card = shipped.task.name, shipped.card
    if name == "ring_peg":  # 39,530 states, 5,660 of them with the hole already on the peg
        assert card["count"] >= 39_530
        assert share(shipped, "on_peg") <= 5_660 / 39_530
    elif name == "key_insertion":  # 544,575 states, 120,784 of them with the key somewhere inside the key-hole
        assert share(shipped, "inside") <= 120_784 / 544_575
        assert share(shipped, "at_goal") < 0.01
        assert 0 < share(shipped, "past_bar") < share(shipped, "inside")
    elif name == "ant_maze":  # 510 states, 41 to 90 in each cell
        counts = np.array([card["composition"][f"cell_{k}"]["count"] for k in range(7)])
        assert counts.sum() == card["count"] >= 510
        assert counts.min() >= 41
        assert counts.max() / counts.min() <= 90 / 41
