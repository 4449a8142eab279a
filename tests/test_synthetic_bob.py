"""Figure 6: Alice finds what Bob cannot do yet, and stays there when he can."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.synthetic_bob import DEFAULTS, run


@pytest.mark.slow
def test_alice_is_stuck_once_bob_knows_a_larger_region() -> None:
    rows, proposals = run({**DEFAULTS, "iterations": 16})
    first, settled, last = rows[0], rows[9], rows[-1]
    assert first["share_beyond_radius"] < 0.5
    assert settled["share_beyond_radius"] > 0.8
    assert settled["alice_reward"] > 10 * first["alice_reward"]
    # She goes one way: her proposals are a small part of the ring that would pay as much.
    angles = np.arctan2(*proposals[10].T)
    assert np.abs(np.mean(np.exp(1j * angles))) > 0.8
    assert last["radius"] > settled["radius"]
    assert last["alice_reward"] == 0
    assert last["share_beyond_radius"] == 0
    assert abs(last["distance_median"] - settled["distance_median"]) < 1.0
