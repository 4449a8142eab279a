"""The tool that makes feasible starts keeps its word; what is on the peg of ring_peg."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax import feasible
from rcg_jax.curriculum.feasible import cells, clearance, limit_excess, make_settle
from rcg_jax.io.starts_file import hash_starts, load_states
from rcg_jax.tasks import TASKS, make_task
from rcg_jax.tasks.ring_peg import RingPeg
from rcg_jax.types import Snapshot

TINY = ["task=ring_peg", "num_states=40", "max_rounds=3", "num_walks=16", "walk_length=60"]


@pytest.fixture(scope="module")
def task() -> RingPeg:
    return make_task("ring_peg", "native")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("starts") / "new" / "tiny.npz"
    assert feasible.main([*TINY, f"out={out}"]) == 0
    return out


def test_checks_notice_overlap_limits_and_motion(task):
    goal = np.asarray(task.goal_state, np.float32)
    pressed = goal + np.float32([0, 0, 0, 0, 0, 0.2, 0])  # the wrist bends the disk into table and peg
    beyond = goal.copy()
    beyond[3] = 0.1
    states = np.stack([goal, pressed, beyond])
    depth = clearance(task.model, states)
    assert depth[0] > -0.001
    assert depth[1] < -0.005
    assert limit_excess(task.model, states)[2] == pytest.approx(0.1, abs=1e-6)
    assert limit_excess(task.model, states)[0] < 0
    stays, drift = make_settle(task, 50)(states)
    assert stays[0]
    assert drift[0] < 0.1
    assert drift[1] > 0.1
    far = np.zeros((1, 7), np.float32)  # stretched out, the disk is a metre from the peg
    assert not make_settle(task, 1)(far)[0][0]
    assert make_settle(task, 1)(states[:0])[0].shape == (0,)


def snapshot(task: RingPeg, centre: tuple[float, float, float], tilt: float = 0.0, axis: int = 0) -> Snapshot:
    """The disk's centre relative to the peg's axis (x, y) and in the world (z), turned by ``tilt`` about x or y."""
    c, s = np.cos(tilt), np.sin(tilt)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) if axis == 0 else np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    xmat = np.tile(np.eye(3), (task.model.nbody, 1, 1))
    xmat[task.model.body("wrist_roll").id] = turn
    sites = np.zeros((task.model.nsite, 3))
    sites[task.model.site("disk").id] = np.add(centre, [0, 0.3, 0])
    return Snapshot(
        qpos=jnp.zeros(7),
        qvel=jnp.zeros(7),
        xpos=jnp.zeros((task.model.nbody, 3)),
        xmat=jnp.asarray(xmat),
        site_xpos=jnp.asarray(sites),
        com=jnp.zeros(3),
    )


# The peg's tip is at z = -0.275; the disk is 5 cm thick and its hole 6.6 cm wide.
ON_PEG = {
    "lying on the table": ((0, 0, -0.4), 0.0, 0, True),
    "upside down": ((0, 0, -0.4), np.pi, 0, True),
    "tip at its upper face": ((0, 0, -0.3), 0.0, 0, True),
    "tip just in the hole": ((0, 0, -0.251), 0.0, 0, True),
    "just above the tip": ((0, 0, -0.249), 0.0, 0, False),
    "beside the peg": ((0.034, 0, -0.4), 0.0, 0, False),
    "beside the peg in y": ((0, -0.034, -0.4), 0.0, 0, False),
    "off centre within the hole": ((0.03, -0.03, -0.4), 0.0, 0, True),
    "tilted a little": ((0, 0, -0.3), 0.3, 0, True),
    "tilted more than a peg in the hole can be": ((0, 0, -0.28), 0.5, 1, False),
    "upright beside the peg's top": ((0, 0, -0.3), np.pi / 2, 1, False),
    # Tilted by 0.3 about y, the hole's edge at x = -0.033 is met 3.45 cm from the centre on the horizontal.
    "tilted, the axis within the hole": ((0.031, 0, -0.3), 0.3, 1, True),
    "tilted, the axis outside": ((0.032, 0, -0.3), 0.3, 1, False),
}


@pytest.fixture(scope="module")
def composition(task):
    return jax.jit(task.composition)


@pytest.mark.parametrize("case", ON_PEG)
def test_on_peg(task, composition, case):
    centre, tilt, axis, expected = ON_PEG[case]
    assert bool(composition(snapshot(task, centre, tilt, axis))["on_peg"]) is expected


def test_training_that_a_run_would_refuse_is_refused_before_the_search(tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(
        "from rcg_jax.tasks import RingPeg\n\nclass Mine(RingPeg):\n    training = {'rollout.num_env': 3}\n"
    )
    assert feasible.main([f"task={file}:Mine", *TINY[1:], f"out={tmp_path / 'a.npz'}"]) == 2
    message = one_line(capsys)
    assert "training: rollout.num_env must be the dotted name" in message
    assert "did you mean rollout.num_envs?" in message
    assert not (tmp_path / "a.npz").exists()


def test_tiny_run_writes_valid_starts_and_their_card(task, tiny):
    qpos = load_states(tiny)[0]
    card = json.loads(tiny.with_suffix(".json").read_text())
    assert {key: card[key] for key in ("task", "sha256", "count")} == {
        "task": "ring_peg",
        "sha256": hash_starts(qpos),
        "count": len(qpos),
    }
    assert len(qpos) == 40
    assert card["command"] == "python -m rcg_jax.feasible " + " ".join(TINY)
    assert card["stopped_by"] == "num_states"
    assert card["search"]["growth"][-1]["starts"] == card["search"]["found"] > 40
    assert card["search"]["visited"] <= 3 * 16 * 60 + 1
    assert len(np.unique(cells(qpos, 0.2), axis=0)) == len(qpos)
    assert clearance(task.model, qpos).min() >= -0.001
    assert sorted(path.name for path in tiny.parent.iterdir()) == ["tiny.json", "tiny.npz"]


@pytest.mark.slow
def test_tiny_run_depends_on_the_seed_and_on_nothing_else(tiny, tmp_path):
    assert feasible.main([*TINY, f"out={tmp_path / 'same.npz'}"]) == 0
    assert (tmp_path / "same.npz").read_bytes() == tiny.read_bytes()
    assert feasible.main([*TINY, "seed=1", "num_states=100000", "max_rounds=2", f"out={tmp_path / 'other.npz'}"]) == 0
    other = load_states(tmp_path / "other.npz")[0]
    assert not {row.tobytes() for row in load_states(tiny)[0]} & {row.tobytes() for row in other}
    card = json.loads((tmp_path / "other.json").read_text())
    assert card["stopped_by"] == "max_rounds"
    assert card["count"] == card["search"]["found"] == len(other)
    assert card["search"]["walks"] == 2 * 16


@pytest.mark.slow
def test_longer_search_keeps_a_random_subset(tmp_path):
    words = ["num_found=80", "max_rounds=20"]
    every = feasible.main([*TINY, *words, "num_states=80", f"out={tmp_path / 'every.npz'}"])
    some = feasible.main([*TINY, *words, f"out={tmp_path / 'some.npz'}"])
    assert every == some == 0
    card = json.loads((tmp_path / "some.json").read_text())
    assert card["count"] == 40
    assert card["stopped_by"] == "num_found"
    assert card["search"]["found"] >= 80
    everything, chosen = (list(map(bytes, load_states(tmp_path / f"{n}.npz")[0])) for n in ("every", "some"))
    places = np.flatnonzero([row in chosen for row in everything])
    assert 10 < np.sum(places < len(everything) // 2) < 30  # not the first, not the last


def test_search_ends_when_nothing_new_is_found(tmp_path):
    out = tmp_path / "starts.npz"
    assert feasible.main([*TINY, "grid=100", "max_rounds=20", f"out={out}"]) == 0
    card = json.loads(out.with_suffix(".json").read_text())
    assert card["stopped_by"] == "saturated"
    assert 1 <= card["count"] <= 2**7  # joint angles of either sign


def test_a_goal_set_without_an_outside_is_refused(tmp_path, capsys, monkeypatch):
    class Solved(RingPeg):
        def composition(self, s):
            return {"at_goal": s.qpos[0] < np.inf}

    monkeypatch.setitem(TASKS, "ring_peg", Solved)
    assert feasible.main([*TINY, f"out={tmp_path / 'starts.npz'}"]) == 2
    assert "is_goal: holds in all of the" in one_line(capsys)
    assert not list(tmp_path.iterdir())


def test_goal_state_in_collision_is_refused(tmp_path, capsys, monkeypatch):
    class Pressed(RingPeg):
        goal_state = np.add(RingPeg.goal_state.fget(None), [0, 0, 0, 0, 0, 0.2, 0])
        goal_radius = 0.05

    monkeypatch.setitem(TASKS, "ring_peg", Pressed)
    assert feasible.main([*TINY, f"out={tmp_path / 'starts.npz'}"]) == 2
    assert "goal_state is in penetration: geom peg and geom ring_left overlap by 0.028 m" in one_line(capsys)
    # Where the task's own search allows it and the command line does not.
    Pressed.search = RingPeg.search | {"max_depth": 0.03}
    assert feasible.main([*TINY, "max_depth=0.02", f"out={tmp_path / 'starts.npz'}"]) == 2
    message = one_line(capsys)
    assert "max_depth=0.02" in message
    assert "the goal state does not pass these checks: geom peg and geom ring_left overlap by 0.028 m" in message
    assert not list(tmp_path.iterdir())


def test_existing_files_are_replaced_only_on_demand(tiny, tmp_path, capsys, monkeypatch):
    before = tiny.read_bytes()
    assert feasible.main([*TINY, f"out={tiny}"]) == 2
    assert "exists; overwrite=true" in one_line(capsys)
    assert tiny.read_bytes() == before
    out = tmp_path / "starts.npz"
    out.write_bytes(b"old")
    result = feasible.Result(qpos=load_states(tiny)[0], stopped="num_states", search={})
    monkeypatch.setattr(feasible, "generate", lambda *_: result)
    assert feasible.main([*TINY, f"out={out}", "overwrite=true"]) == 0
    assert out.read_bytes() == before


def test_interrupted_run_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(feasible, "generate", interrupt)
    assert feasible.main([*TINY, f"out={tmp_path / 'a' / 'starts.npz'}"]) == 130
    assert one_line(capsys) == "stopped; nothing was written"
    assert not list(tmp_path.iterdir())


def one_line(capsys) -> str:
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    return err.strip()
