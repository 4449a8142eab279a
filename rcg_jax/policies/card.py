"""The card of a trained policy: what it was trained on, what it sees and does, and how often it succeeds.

Nothing here needs JAX or MuJoCo.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any, get_args, get_origin, get_type_hints

from rcg_jax.types import ObservationPart

#: Version of the files that :mod:`rcg_jax.policies.policy_file` writes and reads.
FORMAT = 2

#: The version before: without ``action_repeat``, which was 1.
_ONE_STEP = 1


@dataclass(frozen=True)
class Score:
    """Episodes from rho_0, and how many reached the goal.

    ``low`` and ``high`` are the 95 % Wilson interval of the success probability.
    """

    successes: int
    episodes: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        """Share of the episodes that reached the goal."""
        return self.successes / self.episodes


@dataclass(frozen=True)
class PolicyCard:
    """What a file of a trained policy says about it.

    Attributes:
        format: :data:`FORMAT` of the pair of files.
        task: name of its task, or of the class of an own one.
        method, preset, engine, seed: how it was trained.
        iteration, env_steps: for how long; steps of policy rollouts.
        observation: parts of its observation, in order.
        obs_epsilon, obs_clip: it sees ``clip((obs - obs_mean) / sqrt(obs_var + obs_epsilon), -obs_clip, obs_clip)``.
        hidden, activation: widths of the hidden layers of the network; what follows each of them.
        action_low, action_high: actions are clipped to this range and then scaled to ``ctrl_low`` .. ``ctrl_high``.
        action_std: (nu,) standard deviation of the stochastic policy, before the clipping.
        actuators: (nu,) names of the actuators, or of the joints that they drive.
        ctrl_low, ctrl_high: (nu,) their range, in their own units.
        timestep_s, action_repeat: time of a step of physics [s]; k, steps that each action is held for.
        horizon: longest episode [steps].
        stochastic, mean: success of the stochastic policy and of its mean action.
        starts_sha256: hash of the feasible starts that these are over (:func:`rcg_jax.io.starts_file.hash_starts`).
        rcg_jax, jax, mujoco: versions of the packages that wrote it.
        arrays_sha256: digest of the arrays beside it.
    """

    format: int
    task: str
    method: str
    preset: str
    engine: str
    seed: int
    iteration: int
    env_steps: int
    observation: tuple[ObservationPart, ...]
    obs_epsilon: float
    obs_clip: float
    hidden: tuple[int, ...]
    activation: str
    action_low: float
    action_high: float
    action_std: tuple[float, ...]
    actuators: tuple[str, ...]
    ctrl_low: tuple[float, ...]
    ctrl_high: tuple[float, ...]
    timestep_s: float
    action_repeat: int
    horizon: int
    stochastic: Score
    mean: Score
    starts_sha256: str
    rcg_jax: str
    jax: str
    mujoco: str
    arrays_sha256: str

    @property
    def obs_dim(self) -> int:
        """Length of an observation."""
        return sum(part.size for part in self.observation)

    @property
    def action_dim(self) -> int:
        """nu, length of an action."""
        return len(self.action_std)


def _plain(card: PolicyCard) -> dict[str, Any]:
    """The card as JSON has it."""
    tree = dataclasses.asdict(card) | {"observation": [part._asdict() for part in card.observation]}
    if card.format == _ONE_STEP:
        del tree["action_repeat"]
    return tree


def encode_card(card: PolicyCard) -> bytes:
    """The content of a card's file. The same card gives the same bytes."""
    return (json.dumps(_plain(card), indent=2, ensure_ascii=False) + "\n").encode()


def card_digest(card: PolicyCard) -> str:
    """SHA-256 (hex) of what a card says, however its file is laid out."""
    text = json.dumps(_plain(card), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def decode_card(content: bytes) -> PolicyCard:
    """Reads what :func:`encode_card` wrote.

    Raises:
        ValueError: it is no card, or one of another format; the message says what does not fit.
    """
    try:
        tree = json.loads(content.decode())
    except ValueError as error:
        raise ValueError(f"it is no JSON: {error}") from None
    if not isinstance(tree, dict) or type(tree.get("format")) is not int:
        raise ValueError("it has no format version")
    if tree["format"] not in (_ONE_STEP, FORMAT):
        advice = "update rcg_jax" if tree["format"] > FORMAT else "export the policy again"
        reads = f"this version of rcg_jax reads {_ONE_STEP} and {FORMAT}"
        raise ValueError(f"its format is {tree['format']}, {reads}: {advice}")
    if tree["format"] == _ONE_STEP:
        if "action_repeat" in tree:
            raise ValueError("the card: missing or unknown action_repeat")
        tree["action_repeat"] = 1
    card: PolicyCard = _read(PolicyCard, tree, "the card")
    return card


def _read(kind: Any, value: Any, where: str) -> Any:
    """``value``, as JSON has it, as an instance of the type ``kind``."""
    if get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{where} is {value!r}: must be a list")
        return tuple(_read(get_args(kind)[0], one, f"{where}[{i}]") for i, one in enumerate(value))
    if dataclasses.is_dataclass(kind) or kind is ObservationPart:
        types, found = get_type_hints(kind), set(value) if isinstance(value, dict) else set()
        if found != set(types):
            raise ValueError(f"{where}: missing or unknown {', '.join(sorted(found ^ set(types)))}")
        return kind(**{name: _read(types[name], value[name], name) for name in types})  # type: ignore[operator]
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ValueError(f"{where} is {value!r}: must be of type {kind.__name__}")
    return value
