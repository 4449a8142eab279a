"""The cards of the shipped policies are true."""

from __future__ import annotations

import numpy as np
import pytest

from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.io.assets import POLICIES
from rcg_jax.policies import __main__ as policies
from rcg_jax.policies.policy_file import load_policy, shipped_policies
from rcg_jax.runs.evaluation import evaluate_run
from rcg_jax.runs.load import load_policy_with_task

EPISODES = 150


def test_there_are_some_and_nothing_else_lies_beside_them() -> None:
    assert shipped_policies()
    names = {f"{name}{suffix}" for name in shipped_policies() for suffix in (".npz", ".json")}
    assert {path.name for path in POLICIES.iterdir()} == names
    assert sum(path.stat().st_size for path in POLICIES.iterdir()) < 60_000 * len(shipped_policies())


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_policies())
def test_the_card_is_true(name: str) -> None:
    trained = load_policy_with_task(name, engine="native")
    card, task = load_policy(name).card, trained.task
    assert card.observation == task.observation_parts()
    assert (card.horizon, card.timestep_s) == (task.horizon, task.model.opt.timestep)
    np.testing.assert_allclose([card.ctrl_low, card.ctrl_high], task.model.actuator_ctrlrange.T)
    assert card.action_std == pytest.approx(np.exp(trained.actor.policy.log_std))
    assert card.starts_sha256 == task.starts_sha256()
    result = evaluate_run(trained, episodes=EPISODES, seed=1)
    for claim, found in ((card.stochastic, result.stochastic), (card.mean, result.mean)):
        assert (claim.low, claim.high) == pytest.approx(wilson_interval(claim.successes, claim.episodes), abs=1e-6)
        # Two samples of one probability: the chance that these intervals of 3.3 sigma do not meet is below 1e-5.
        low, high = wilson_interval(claim.successes, claim.episodes, z=3.3)
        low_now, high_now = wilson_interval(int(found.success.sum()), EPISODES, z=3.3)
        assert low < high_now, (claim.rate, found.rate)
        assert low_now < high, (claim.rate, found.rate)


def test_they_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert policies.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == shipped_policies()
    assert f"{load_policy(shipped_policies()[0]).card.stochastic.rate:.3f} [" in lines[1]
    assert policies.main(["everything"]) == 2
