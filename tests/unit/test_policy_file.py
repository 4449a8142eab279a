"""Policies as files: what goes in comes out and acts as in training, and damage never goes unnoticed."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcg_jax import load_policy
from rcg_jax.io.manifest import array_digest
from rcg_jax.policies.card import FORMAT, PolicyCard, Score, card_digest
from rcg_jax.policies.policy_file import PolicyFileError, policy_arrays, save_policy
from rcg_jax.rl.policy import Actor, GaussianPolicy, ObsNormalizer
from rcg_jax.types import ObservationPart

HIDDEN, OBS, ACTIONS = (8, 6), 5, 2
PI = GaussianPolicy(ACTIONS, hidden=HIDDEN, learn_std=True, output_gain=3.0)


def make_actor() -> Actor:
    rng = np.random.default_rng(0)
    norm = ObsNormalizer.init(OBS).update(jnp.asarray(rng.normal(2.0, [0.01, 1, 5, 0, 1], (100, OBS)), jnp.float32))
    params = jax.jit(lambda key: PI.init(key, OBS, 0.5))(jax.random.key(1))
    mlp = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), x.dtype), params.mlp)
    return Actor(policy=params.replace(mlp=mlp, log_std=jnp.array([-1.0, 0.2])), norm=norm)


def make_card(actor: Actor, **changes: object) -> PolicyCard:
    card = PolicyCard(
        format=FORMAT,
        task="tiny",
        method="reverse",
        preset="default",
        engine="native",
        seed=3,
        iteration=4,
        env_steps=1000,
        observation=(ObservationPart("position", 2, "m", "data.qpos"), ObservationPart("others", 3)),
        obs_epsilon=1e-6,
        obs_clip=10.0,
        hidden=HIDDEN,
        activation="tanh",
        action_low=-1.0,
        action_high=1.0,
        action_std=(0.37, 1.22),
        actuators=("x", "y"),
        ctrl_low=(-2.0, -2.0),
        ctrl_high=(2.0, 2.0),
        timestep_s=0.02,
        action_repeat=2,
        horizon=50,
        stochastic=Score(5, 10, 0.2, 0.8),
        mean=Score(6, 10, 0.3, 0.9),
        starts_sha256="ab" * 32,
        rcg_jax="0.1.0",
        jax="0",
        mujoco="0",
        arrays_sha256=array_digest(policy_arrays(actor)),
    )
    return dataclasses.replace(card, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def actor() -> Actor:
    return make_actor()


@pytest.fixture
def path(actor: Actor, tmp_path: Path) -> Path:
    save_policy(tmp_path / "one.npz", actor, make_card(actor))
    return tmp_path / "one.npz"


OBSERVATIONS = jnp.asarray(np.random.default_rng(1).normal(2.0, 3.0, (4, 7, OBS)), jnp.float32)


def test_round_trip(path: Path, actor: Actor, tmp_path: Path) -> None:
    policy = load_policy(path)
    for name, array in policy_arrays(actor).items():
        np.testing.assert_array_equal(policy_arrays(policy.actor)[name], array)
    assert policy.card == make_card(actor)
    assert policy.card.stochastic.rate == 0.5
    again = tmp_path / "again.npz"
    save_policy(again, policy.actor, policy.card)
    assert again.read_bytes() == path.read_bytes()
    assert again.with_suffix(".json").read_bytes() == path.with_suffix(".json").read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["again.json", "again.npz", "one.json", "one.npz"]
    assert load_policy(str(path.with_suffix(".json"))).card == policy.card


def test_it_acts_as_in_training(path: Path, actor: Actor) -> None:
    policy = load_policy(path)
    expected = PI(actor.policy, actor.norm(OBSERVATIONS))
    assert np.abs(expected.mean).max() > 1.5  # some are clipped
    np.testing.assert_array_equal(policy.mean(OBSERVATIONS), np.clip(expected.mean, -1, 1))
    key = jax.random.key(2)
    noise = jax.random.normal(key, (4, 7, ACTIONS))
    np.testing.assert_array_equal(policy.sample(key, OBSERVATIONS), np.clip(expected.sample(noise), -1, 1))
    # One observation, and jitted with the policy as an argument.
    np.testing.assert_allclose(policy.mean(OBSERVATIONS[0, 0]), policy.mean(OBSERVATIONS)[0, 0], atol=1e-6)
    jitted = jax.jit(lambda policy, obs: policy.mean(obs))(policy, OBSERVATIONS)
    np.testing.assert_allclose(jitted, policy.mean(OBSERVATIONS), atol=1e-6)


def test_numpy_is_enough(path: Path) -> None:
    arrays = np.load(path, allow_pickle=False)
    x = np.clip((OBSERVATIONS - arrays["obs_mean"]) / np.sqrt(arrays["obs_var"] + 1e-6), -10, 10)
    for k in (0, 1):
        x = np.tanh(x @ arrays[f"weight_{k}"] + arrays[f"bias_{k}"])
    mean = np.clip(x @ arrays["weight_2"] + arrays["bias_2"], -1, 1)
    np.testing.assert_allclose(mean, load_policy(path).mean(OBSERVATIONS), atol=1e-5)


@pytest.mark.parametrize("shape", [(), (OBS + 1,), (3, OBS - 1), (OBS, 1)])
def test_observations_of_another_length_are_refused(path: Path, shape: tuple[int, ...]) -> None:
    policy = load_policy(path)
    for act in (policy.mean, lambda obs: policy.sample(jax.random.key(0), obs)):
        with pytest.raises(ValueError, match=r"the last axis must be 5 \(position 2, others 3\)"):
            act(jnp.zeros(shape))


def refusal(name: Path | str) -> str:
    with pytest.raises(PolicyFileError) as error:
        load_policy(name)
    assert "\n" not in str(error.value)
    return str(error.value)


def edit(path: Path, **changes: object) -> None:
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps({**card, **changes}))


def test_missing_ones(path: Path, tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "two.npz")
    (tmp_path / "notes.md").write_text("no policy")
    assert refusal(tmp_path / "notes.md").endswith("must be a file *.npz")
    assert "shipped policy (" in refusal("nothing")
    assert "did you mean point_maze?" in refusal("point_mase")
    assert "no policy.npz in this folder" in refusal(tmp_path)
    path.with_suffix(".json").unlink()
    assert f"{path.with_suffix('.json')}: no such file" in refusal(path)


def test_a_policy_of_format_1_acts_in_every_step(tmp_path: Path) -> None:
    """It has no ``action_repeat``, and its arrays hold the digest of the card without it."""
    actor = make_actor()
    path = tmp_path / "old.npz"
    save_policy(path, actor, make_card(actor, format=1, action_repeat=1))
    assert "action_repeat" not in json.loads(path.with_suffix(".json").read_text())
    card = load_policy(path).card
    assert (card.format, card.action_repeat) == (1, 1)
    tree = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(tree | {"action_repeat": 4}))
    with pytest.raises(PolicyFileError, match="unknown action_repeat"):
        load_policy(path)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"format": FORMAT + 1},
            f"its format is {FORMAT + 1}, this version of rcg_jax reads 1 and {FORMAT}: update rcg_jax",
        ),
        ({"format": None}, "no format version"),
        ({"seed": 4}, "not the card that one.npz was written with"),
        ({"seed": "3"}, "seed is '3': must be of type int"),
        ({"extra": 1}, "missing or unknown extra"),
        ({"hidden": [8]}, "not the card"),
        ({"hidden": 8}, "hidden is 8: must be a list"),
        ({"mean": {"successes": 1}}, "mean: missing or unknown episodes, high, low"),
        ({"activation": "relu"}, "another activation"),
    ],
)
def test_changed_cards(path: Path, changes: dict[str, object], expected: str) -> None:
    edit(path, **changes)
    assert expected in refusal(path)


def other_weights(actor: Actor) -> Actor:
    return actor.replace(policy=actor.policy.replace(log_std=actor.policy.log_std + 1))


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lambda actor: (other_weights(actor), make_card(actor)), "do not match the digest"),
        (
            lambda actor: (actor, make_card(actor, hidden=(8, 7))),
            "weight_1 is float32[8, 6], its card says float32[8, 7]",
        ),
        (
            lambda actor: (actor, make_card(actor, hidden=(8, 6, 6))),
            "weight_2 is float32[6, 2], its card says",
        ),
    ],
)
def test_arrays_that_do_not_fit_their_card(
    actor: Actor, tmp_path: Path, build: Callable[[Actor], tuple[Actor, PolicyCard]], expected: str
) -> None:
    save_policy(tmp_path / "one.npz", *build(actor))
    assert expected in refusal(tmp_path / "one.npz")


@pytest.mark.parametrize("content", ["my results", '{"format": 3}', "[]"])
def test_a_card_never_replaces_another_file(actor: Actor, tmp_path: Path, content: str) -> None:
    (tmp_path / "one.json").write_text(content)
    with pytest.raises(PolicyFileError, match=r"out=.*one\.npz: its card would replace .*one\.json") as caught:
        save_policy(tmp_path / "one.npz", actor, make_card(actor))
    assert "\n" not in str(caught.value)
    assert (tmp_path / "one.json").read_text() == content
    assert not (tmp_path / "one.npz").exists()


def test_a_card_of_another_policy_is_refused(path: Path, actor: Actor, tmp_path: Path) -> None:
    """As after a kill between the two files."""
    other = other_weights(actor)
    save_policy(tmp_path / "other.npz", other, make_card(other))
    (tmp_path / "other.npz").replace(path)
    assert "not the card" in refusal(path)


def test_pickles_are_never_read(path: Path, actor: Actor) -> None:
    arrays = {**policy_arrays(actor), "log_std": np.array([{}], object)}
    np.savez_compressed(path, **arrays, card_sha256=np.array(card_digest(make_card(actor))))
    assert "damaged" in refusal(path)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_damaged_files_are_never_read_as_another_policy(path: Path, actor: Actor, suffix: str) -> None:
    file = path.with_suffix(suffix)
    content, expected, errors = file.read_bytes(), policy_arrays(actor), 0
    for position in range(0, len(content), 5):
        file.write_bytes(content[:position] + bytes([content[position] ^ 0x15]) + content[position + 1 :])
        try:
            found = load_policy(path)
        except PolicyFileError:
            errors += 1
            continue
        # Some bytes of a zip archive mean nothing, such as its time stamps; nor do spaces in JSON.
        assert found.card == make_card(actor)
        assert array_digest(policy_arrays(found.actor)) == array_digest(expected)
    assert errors > 0.4 * len(content) / 5
    for length in range(0, len(content) - 1, 41):
        file.write_bytes(content[:length])
        refusal(path)


def test_reading_needs_neither_mujoco_nor_the_training_stack(path: Path) -> None:
    program = (
        "import sys, jax.numpy as jnp, rcg_jax; policy = rcg_jax.load_policy(sys.argv[1]); "
        f"policy.mean(jnp.zeros({OBS})); "
        "print([m for m in sys.modules if m in ('mujoco', 'optax', 'orbax', 'hydra') or m.startswith('rcg_jax.tasks')])"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
