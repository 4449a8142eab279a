"""Pytrees shared by every layer, and the shape letters used in all docstrings.

Shape letters:
    B   a batch of simulated environments, always the leading axis
    N   environments of a training rollout (``rollout.num_envs``)
    L   physics steps of one rollout segment (``rollout.batch_size / num_envs``)
    C   capacity of a set of start states (the number of *valid* ones varies, shapes do not)
    T   horizon of an episode, in physics steps
    S   seeds trained side by side under ``vmap``
    nq, nv, nu   sizes of positions, velocities and controls of the MuJoCo model
    na           size of its actuators' activations; where there are none, the field ``act`` is None: no leaf at all
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

Tree = TypeVar("Tree")


@struct.dataclass
class PhysicsState:
    """State of B simulations; the same small pytree for every engine.

    Attributes:
        qpos: (B, nq) generalised positions [rad, m].
        qvel: (B, nv) generalised velocities [rad/s, m/s].
        qacc_warmstart: (B, nv) the solver's initial guess [rad/s^2, m/s^2]; part of the state, so that a
            trajectory depends on nothing else.
        bad: (B,) bool, the last step gave a non-finite state. Such a row keeps its state from before that step.
        act: (B, na) activations of the actuators that have one; None where na = 0.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    bad: Array
    act: Array | None = None


@struct.dataclass
class Snapshot:
    """One physical state with its kinematics, as tasks see it (no batch axis: the callers vmap).

    Attributes:
        qpos: (nq,) positions.
        qvel: (nv,) velocities.
        xpos: (nbody, 3) body frame origins in the world [m], at this ``qpos``.
        xmat: (nbody, 3, 3) body frame rotations.
        site_xpos: (nsite, 3) site positions in the world [m].
        com: (3,) centre of mass of everything that moves [m].
        act: (na,) activations of the actuators that have one; None where na = 0.
    """

    qpos: Array
    qvel: Array
    xpos: Array
    xmat: Array
    site_xpos: Array
    com: Array
    act: Array | None = None


@struct.dataclass
class StartSet:
    """Start states with a static capacity C; rows where ``valid`` is False hold no start.

    Attributes:
        qpos: (C, nq).
        qvel: (C, nv); the paper's starts are at rest.
        valid: (C,) bool.
        act: (C, na) activations of the actuators that have one; None where na = 0. A start at rest keeps the ones that
            its positions were reached with.
    """

    qpos: Array
    qvel: Array
    valid: Array
    act: Array | None = None

    @classmethod
    def at_rest(cls, qpos: Array, nv: int, act: Array | None = None) -> StartSet:
        """Positions (C, nq) with ``nv`` velocities of zero each and activations (C, na), all of them valid.

        Without activations, of a model that has some, simulations begin with :meth:`rcg_jax.Task.neutral_act`.
        """
        qpos = jnp.asarray(qpos, jnp.float32)
        act = None if act is None else jnp.asarray(act, jnp.float32)
        return cls(qpos=qpos, qvel=jnp.zeros((len(qpos), nv), jnp.float32), valid=jnp.ones(len(qpos), bool), act=act)

    @property
    def capacity(self) -> int:
        """C, the static number of rows."""
        return self.valid.shape[0]

    def count(self) -> Array:
        """Number of valid starts, () int32."""
        return jnp.sum(self.valid, dtype=jnp.int32)

    def take(self, index: Array) -> StartSet:
        """Rows ``index`` (K,) as a StartSet of capacity K."""
        return jax.tree.map(lambda x: x[index], self)


@struct.dataclass
class StartLabels:
    """What training showed about each start of rho_i. Labels of several batches add up.

    Attributes:
        successes: (C,) int32, counted episodes that reached the goal.
        episodes: (C,) int32, counted episodes.
        steps: (C,) int32, steps to the goal, summed over the successes.
    """

    successes: Array
    episodes: Array
    steps: Array

    @classmethod
    def none(cls, capacity: int) -> StartLabels:
        """Labels of ``capacity`` starts that nothing is known about."""
        zero = jnp.zeros(capacity, jnp.int32)
        return cls(successes=zero, episodes=zero, steps=zero)

    @property
    def success_rate(self) -> Array:
        """(C,) the paper's ``rews``: estimate of R(pi, s_0); 0 where no episode was counted."""
        return self.successes / jnp.maximum(self.episodes, 1)

    @property
    def time_to_goal(self) -> Array:
        """(C,) mean steps to the goal of the successes; 0 where there was none."""
        return self.steps / jnp.maximum(self.successes, 1)


def concatenate(*sets: StartSet) -> StartSet:
    """One StartSet that holds the rows of all ``sets`` in order."""
    return jax.tree.map(lambda *xs: jnp.concatenate(xs), *sets)


def sample_rows(key: Array, starts: StartSet, num: int) -> Array:
    """Row numbers (num,) of valid starts, uniform; without replacement as long as there are enough of them.

    Args:
        key: PRNG key.
        starts: the set to draw from, capacity C.
        num: how many (static).

    Returns:
        Rows in random order. Where ``starts`` holds fewer valid rows than ``num`` each is repeated equally often (up
        to one); where it holds none, the rows are invalid ones.
    """
    order = jnp.argsort(jnp.where(starts.valid, jax.random.uniform(key, starts.valid.shape), 2.0))
    return order[jnp.arange(num) % jnp.maximum(starts.count(), 1)]


def sample_starts(key: Array, starts: StartSet, num: int) -> StartSet:
    """The starts at :func:`sample_rows`, a StartSet of capacity ``num``."""
    return starts.take(sample_rows(key, starts, num))


def where_rows(mask: Array, new: Tree, old: Tree) -> Tree:
    """Rows of ``new`` where ``mask`` (B,) is true, of ``old`` elsewhere; pytrees of leaves (B, ...)."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def finite(obs: Array) -> tuple[Array, Array]:
    """Observations (..., obs_dim) with zeros in place of those that are not finite, and which are, (...) bool.

    The bound is MuJoCo's for states: squares of what is below it still are float32, as statistics need.
    """
    import mujoco  # reading a policy needs none of it

    fine = jnp.all(jnp.abs(obs) < mujoco.mjMAXVAL, axis=-1)  # False for NaN as well
    return jnp.where(fine[..., None], obs, 0.0), fine


class ObservationPart(NamedTuple):
    """A part of an observation, which is one vector.

    Attributes:
        name: what it is.
        size: how many numbers.
        unit: their unit; of several kinds of joints, all of them.
        source: a Python expression that gives them, to be flattened, of ``data``, a ``mujoco.MjData``; or empty.
    """

    name: str
    size: int
    unit: str = ""
    source: str = ""


def observation_parts(given: Sequence[tuple[Any, ...]], size: int) -> tuple[ObservationPart, ...]:
    """The parts ``given`` of an observation of ``size`` numbers; none given: one part without a unit.

    Raises:
        ValueError: they are no texts and sizes, or the sizes do not add up.
    """
    parts = tuple(ObservationPart(*part) for part in given)
    if not parts:
        return (ObservationPart("observation", size),)
    for part in parts:
        if [type(x) for x in part] != [str, int, str, str]:
            raise ValueError(f"observation: {tuple(part)} must be texts and a size: (name, size, unit, source)")
    if (total := sum(part.size for part in parts)) != size:
        raise ValueError(f"observation: its parts have {total} numbers, observe returns {size}")
    return parts
