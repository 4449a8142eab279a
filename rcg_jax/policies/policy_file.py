"""Trained policies as files: the numbers in ``NAME.npz``, what they mean in the card ``NAME.json`` beside it.

    policy = rcg_jax.load_policy("point_maze")        # or a path
    action = policy.mean(obs)                         # (..., obs_dim) -> (..., nu), in [-1, 1]

The two files know each other's digest, so that a changed, shortened or foreign one is refused. docs/policies.md
documents the arrays for use without this package.
"""

from __future__ import annotations

import difflib
import io
import itertools
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rcg_jax.config.settings import ConfigError
from rcg_jax.io.assets import POLICIES
from rcg_jax.io.manifest import array_digest, brief
from rcg_jax.io.npz import load_npz
from rcg_jax.policies.card import PolicyCard, card_digest, decode_card, encode_card
from rcg_jax.rl.policy import MLP, OBS_CLIP, OBS_EPSILON, Actor, Gaussian, ObsNormalizer, PolicyParams


class PolicyFileError(ConfigError):
    """A trained policy that cannot be read. The message is one line: which file, what is wrong, what to do."""


@struct.dataclass
class Policy:
    """A trained policy; a pytree, whose methods can be jitted, vmapped and differentiated.

    Attributes:
        actor: parameters, and statistics of the observations.
        card: what it is; static.
    """

    actor: Actor
    card: PolicyCard = struct.field(pytree_node=False)

    def _distribution(self, obs: Array) -> Gaussian:
        obs = jnp.asarray(obs, jnp.float32)
        if obs.ndim == 0 or obs.shape[-1] != self.card.obs_dim:
            parts = ", ".join(f"{part.name} {part.size}" for part in self.card.observation)
            raise ValueError(f"observations of shape {obs.shape}: the last axis must be {self.card.obs_dim} ({parts})")
        net = MLP(self.card.hidden, self.card.action_dim)
        mean: Array = net.apply(self.actor.policy.mlp, self.actor.norm(obs))  # type: ignore[assignment]
        return Gaussian(mean=mean, log_std=self.actor.policy.log_std)

    def _clip(self, action: Array) -> Array:
        return jnp.clip(action, self.card.action_low, self.card.action_high)

    def mean(self, obs: Array) -> Array:
        """Mean actions (..., nu) in [-1, 1] for raw observations (..., obs_dim).

        Each is for ``card.action_repeat`` steps of physics.

        Raises:
            ValueError: observations of another length.
        """
        return self._clip(self._distribution(obs).mean)

    def sample(self, key: Array, obs: Array) -> Array:
        """Actions of the stochastic policy, as :meth:`mean`; the rows of a batch have noise of their own.

        Raises:
            ValueError: observations of another length.
        """
        dist = self._distribution(obs)
        return self._clip(dist.sample(jax.random.normal(key, dist.mean.shape)))


def policy_arrays(actor: Actor) -> dict[str, np.ndarray]:
    """The float32 numbers of a policy by name, as docs/policies.md lists them."""
    arrays = {"obs_mean": actor.norm.mean, "obs_var": actor.norm.var, "log_std": actor.policy.log_std}
    layers = actor.policy.mlp["params"]
    for k in range(len(layers)):
        arrays[f"weight_{k}"], arrays[f"bias_{k}"] = layers[f"Dense_{k}"]["kernel"], layers[f"Dense_{k}"]["bias"]
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def _shapes(card: PolicyCard) -> dict[str, tuple[int, ...]]:
    """What the arrays of a policy with this card have to be."""
    widths = (card.obs_dim, *card.hidden, card.action_dim)
    shapes = {"obs_mean": widths[:1], "obs_var": widths[:1], "log_std": widths[-1:]}
    for k, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        shapes[f"weight_{k}"], shapes[f"bias_{k}"] = (inputs, outputs), (outputs,)
    return shapes


def card_path(path: Path) -> Path:
    """Where the card of the policy file ``path`` (``*.npz``) lies."""
    return path.with_suffix(".json")


def check_card_place(path: Path) -> None:
    """Refuses a policy file ``path`` whose card would replace a file that is no policy's card, of whatever format.

    Raises:
        PolicyFileError: another file has the card's name.
    """
    card = card_path(path)
    try:
        tree = json.loads(card.read_bytes())
    except FileNotFoundError:
        return
    except (ValueError, OSError):
        tree = None
    if not isinstance(tree, dict) or not {"format", "arrays_sha256"} <= set(tree):
        what = f"its card would replace {card}, which is no policy's card"
        raise PolicyFileError(f"out={path}: {what}; choose another name")


def save_policy(path: Path, actor: Actor, card: PolicyCard) -> None:
    """Writes ``path`` (``*.npz``) and the card beside it, each as a whole. The same policy gives the same bytes.

    A kill between the two leaves a pair that :func:`load_policy` refuses. The card's ``arrays_sha256`` must be the
    digest of :func:`policy_arrays`.

    Raises:
        PolicyFileError: the card would replace a file that is none; nothing is written.
        OSError: not possible.
    """
    check_card_place(path)
    from rcg_jax.io.tables import write_atomically  # reading needs none of what it imports

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **policy_arrays(actor), card_sha256=np.array(card_digest(card)))  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())
    write_atomically(card_path(path), encode_card(card))


def shipped_policies() -> list[str]:
    """Names of the policies that come with this package."""
    return sorted(path.stem for path in POLICIES.glob("*.npz"))


def find_policy(name: str | Path) -> Path:
    """The file of a policy, given as to :func:`load_policy`.

    Raises:
        PolicyFileError: there is none.
    """
    path, shipped = Path(name).expanduser(), shipped_policies()
    if str(name) in shipped:
        return POLICIES / f"{name}.npz"
    if path.is_dir():
        if (path / "policy.npz").is_file():
            return path / "policy.npz"
        advice = f"python -m rcg_jax.export run={name} makes it of a run"
        raise PolicyFileError(f"policy={name}: no policy.npz in this folder; {advice}")
    path = path.with_suffix(".npz") if path.suffix == ".json" else path
    if path.is_file() and path.suffix == ".npz":
        return path
    if path.is_file():
        raise PolicyFileError(f"policy={name}: must be a file *.npz")
    if path.suffix == ".npz" or "/" in str(name):
        raise PolicyFileError(f"policy={name}: no such file")
    near = difflib.get_close_matches(str(name), shipped, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    known = ", ".join(shipped) or "none yet"
    raise PolicyFileError(f"policy={name}: must be the name of a shipped policy ({known}) or a file *.npz{hint}")


def load_policy(name: str | Path) -> Policy:
    """Reads a trained policy. Needs neither its task nor MuJoCo.

    Args:
        name: of a shipped policy; or path of a file ``*.npz``, of its card ``*.json`` beside it, or of a run's folder.

    Raises:
        PolicyFileError: no such policy; one of the two files is missing, damaged, of another format, or does not
            belong to the other one.
    """
    path = find_policy(name)
    card = read_card(path)
    shapes = _shapes(card)
    try:
        arrays = load_npz(path.read_bytes(), 4 * sum(map(math.prod, shapes.values())))
        expected = str(arrays.pop("card_sha256"))
    except Exception as error:  # what numpy and zipfile raise depends on which byte is wrong
        raise _damaged(path, brief(error)) from None
    if expected != card_digest(card):
        raise _damaged(card_path(path), f"it is not the card that {path.name} was written with")
    if array_digest(arrays) != card.arrays_sha256:
        raise _damaged(path, f"its arrays do not match the digest in {card_path(path).name}")
    for field, shape in shapes.items():
        has = f"{arrays[field].dtype}{list(arrays[field].shape)}" if field in arrays else "missing"
        if has != f"float32{list(shape)}":
            raise _damaged(path, f"{field} is {has}, its card says float32{list(shape)}")
    found = {name: jnp.asarray(array) for name, array in arrays.items()}
    layers = {
        f"Dense_{k}": {"kernel": found[f"weight_{k}"], "bias": found[f"bias_{k}"]} for k in range(len(card.hidden) + 1)
    }
    params = PolicyParams(mlp={"params": layers}, log_std=found["log_std"])
    norm = ObsNormalizer(count=jnp.zeros(()), mean=found["obs_mean"], var=found["obs_var"])
    return Policy(actor=Actor(policy=params, norm=norm), card=card)


def read_card(path: Path) -> PolicyCard:
    """The card of the policy file ``path``.

    Raises:
        PolicyFileError: it is missing, damaged, or of another format.
    """
    file = card_path(path)
    try:
        card = decode_card(file.read_bytes())
        if (card.activation, card.obs_epsilon, card.obs_clip) != ("tanh", OBS_EPSILON, OBS_CLIP):
            raise ValueError("another activation, obs_epsilon or obs_clip than those of its format")
        return card
    except FileNotFoundError:
        raise PolicyFileError(f"{file}: no such file; the card of {path.name} has to lie beside it") from None
    except OSError as error:
        raise PolicyFileError(f"{file}: {error.strerror or error}") from None
    except (ValueError, TypeError) as error:
        raise PolicyFileError(f"{file}: cannot be used: {brief(error)}") from None


def _damaged(path: Path, reason: str) -> PolicyFileError:
    return PolicyFileError(f"{path}: damaged file of a policy ({reason}); copy both files again, or export it again")
