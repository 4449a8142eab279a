"""Defaults, ranges, presets, and the order in which they apply."""

from __future__ import annotations

import pytest

from rcg_jax.config.compose import compose_config
from rcg_jax.config.presets import PRESETS
from rcg_jax.config.settings import Config, ConfigError, flatten


def values(config: Config) -> dict[str, object]:
    return {name: value for name, _, value in flatten(config)}


def test_no_settings_give_the_defaults() -> None:
    assert compose_config([]) == Config()


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_changes_exactly_its_fields(preset: str) -> None:
    changed = {**PRESETS[preset], "preset": preset}
    assert values(compose_config([f"preset={preset}"])) == {**values(Config()), **changed}


@pytest.mark.parametrize("order", [0, 1])
def test_the_user_wins_over_the_preset_in_any_order(order: int) -> None:
    given = ["preset=paper", "trpo.gae_lambda=0.5"]
    config = compose_config(given[::-1] if order else given)
    assert config.trpo.gae_lambda == 0.5
    assert (config.rollout.batch, config.curriculum.noise) == ("episodes", "integrated")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("task=maze", ["task=maze", "ring_peg"]),
        ("method=revers", ["method=revers", "reverse", "uniform"]),
        ("engine=MJX", ["engine=MJX", "mjx", "native"]),
        ("iterations=abc", ["iterations=abc", "integer", ">= 1"]),
        ("iterations=0", ["iterations=0", ">= 1"]),
        ("seed=-1", ["seed=-1", ">= 0"]),
        ("trpo.max_kl=0", ["trpo.max_kl=0", "> 0"]),
        ("trpo.max_kl=nan", ["trpo.max_kl=nan"]),
        ("trpo.gamma=1.5", ["trpo.gamma=1.5", "<= 1"]),
        ("policy.learn_std=maybe", ["policy.learn_std=maybe", "true or false"]),
        ("policy.hidden=64", ["policy.hidden=64", "list of integers"]),
        ("policy.hidden=[64,x]", ["policy.hidden=[64,x]", "list of integers"]),
        ("policy.hidden=[64,0]", ["policy.hidden=[64, 0]", ">= 1"]),
        ("curriculum.r_min=0.9", ["curriculum.r_min=0.9", "curriculum.r_max=0.9"]),
        ("curriculum.rho_0_share=2", ["curriculum.rho_0_share=2", ">= 0", "<= 1"]),
        ("curriculum.brownian_horizon_max=10", ["curriculum.brownian_horizon_max=10", "brownian_horizon=50"]),
        ("curriculum.replay_capacity=9", ["curriculum.replay_capacity=9: must be >= ", "= 90"]),
        ("tsk=ring_peg", ["tsk=ring_peg", "did you mean task?"]),
        ("trpo.max_kll=1", ["trpo.max_kll=1", "did you mean trpo.max_kl?"]),
        ("max_kl=1", ["max_kl=1", "did you mean trpo.max_kl?"]),
        ("qqq=1", ["qqq=1", "iterations", "trpo"]),
        ("trpo=1", ["trpo=1", "trpo.max_kl"]),
        ("+seed=1", ["+seed=1", "seed=value"]),
        ("~seed", ["~seed"]),
        ("seed=1,2", ["seed=1,2", "-m"]),
        ("seed", ["seed", "name=value"]),
        ("run_dir=${nothing}", ["nothing"]),
        ("devices=0", ["devices=0", ">= 1, or all"]),
        ("devices=two", ["devices=two", ">= 1, or all"]),
        ("devices=2 engine=native", ["devices=2", "engine=native", "must be 1"]),
        ("devices=all engine=native", ["devices=all", "engine=native", "must be 1"]),
        ("devices=2 engine=warp", ["devices=2: engine=warp uses one device; must be 1, or engine=mjx"]),
        ("hosts.coordinator=slurm engine=warp", ["hosts.coordinator=slurm: engine=warp uses one host; must be none"]),
        ("hosts.coordinator=slurm engine=native", ["hosts.coordinator=slurm", "engine=native", "none"]),
        ("hosts.coordinator=node1", ["hosts.coordinator=node1", "none, slurm, or host:port"]),
        ("hosts.coordinator=node1:99999 hosts.processes=2", ["coordinator=node1:99999", "<= 65535"]),
        ("hosts.processes=2", ["hosts.processes=2", "hosts.coordinator=host:port"]),
        (
            "hosts.coordinator=node1:1234 hosts.processes=2 hosts.process=2",
            ["hosts.process=2", "< hosts.processes=2"],
        ),
    ],
)
def test_a_wrong_setting_is_one_line_with_field_value_and_what_is_allowed(text: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        compose_config(text.split())
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_environments_must_divide_a_batch_that_is_set() -> None:
    with pytest.raises(ConfigError, match=r"rollout\.batch_size=50000: must be a multiple of rollout\.num_envs=300"):
        compose_config(["rollout.num_envs=300", "rollout.batch_size=50000"])
    compose_config(["rollout.num_envs=300"])  # then the batch depends on the task


def test_the_error_is_about_the_wrong_one_of_several_settings() -> None:
    with pytest.raises(ConfigError, match=r"^trpo\.max_kl=x: "):
        compose_config(["seed=1", "trpo.max_kl=x", "policy.hidden=[8]"])


def test_types_survive_composition() -> None:
    config = compose_config(["trpo.max_kl=1", "policy.hidden=[8,9]", "policy.learn_std=true", "iterations=1_000"])
    assert isinstance(config.trpo.max_kl, float)
    assert config.policy.hidden == [8, 9]
    assert isinstance(config.policy.hidden, list)
    assert config.policy.learn_std is True
    assert config.iterations == 1000
