"""What a task is: a model, one goal state, and a few functions of a state (paper, sections 3.2 and 3.3)."""

from __future__ import annotations

import abc
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.base import PhysicsState, Snapshot, StartSet
from rcg_jax.physics import ENGINES, make_engine
from rcg_jax.physics.engine import reset
from rcg_jax.physics.kinematics import make_kinematics
from rcg_jax.starts_file import StartsFileError, load_starts

#: Names of the physics engines a task can be built with.
ENGINE_NAMES = tuple(ENGINES)


class Task(abc.ABC):
    """A goal-oriented task. Subclasses give the class attributes and the functions of one :class:`Snapshot`.

    The functions below take a single state, without batch axis, in jnp; the pipeline vmaps them.

    Attributes:
        name: registered name.
        xml: path of the MJCF file.
        horizon: T, physics steps per episode.
        feasible_file: npz with the feasible starts S^0, written by ``python -m rcg_jax.feasible``.
    """

    name: str
    xml: Path
    feasible_file: Path
    horizon: int = 500

    def __init__(self, engine: str = "mjx") -> None:
        """Loads the model and binds it to a physics engine.

        Args:
            engine: one of :data:`ENGINE_NAMES`.
        """
        self.model = mujoco.MjModel.from_xml_path(str(self.xml))
        self.engine = make_engine(engine, self.model)
        self._kinematics = make_kinematics(self.model)

    @property
    @abc.abstractmethod
    def goal_state(self) -> np.ndarray:
        """s^g, (nq,): one state in which the task is achieved (assumption 2)."""

    @abc.abstractmethod
    def observe(self, s: Snapshot) -> Array:
        """Observation of the policy, (obs_dim,)."""

    @abc.abstractmethod
    def distance(self, s: Snapshot) -> Array:
        """Distance to the goal [m], (): for metrics and pictures."""

    @abc.abstractmethod
    def is_goal(self, s: Snapshot) -> Array:
        """Whether s is in S^g, () bool."""

    @abc.abstractmethod
    def is_feasible(self, s: Snapshot) -> Array:
        """Whether s lies in the region of S^0, () bool. A Brownian walk stops where it leaves this region."""

    def is_failure(self, s: Snapshot) -> Array:
        """Whether an episode ends here without success, () bool. Never, unless a task says so."""
        return jnp.zeros((), bool)

    def composition(self, s: Snapshot) -> dict[str, Array]:
        """Named subsets of S^0 whose shares a file of feasible starts reports, {name: () bool}."""
        return {"at_goal": self.is_goal(s)}

    @cached_property
    def obs_dim(self) -> int:
        """Length of an observation."""
        return jax.eval_shape(self.observe_batch, jax.eval_shape(lambda: self.reset(self.goal_starts()))).shape[-1]

    @property
    def action_dim(self) -> int:
        """nu, number of actuators; actions span [-1, 1] each and are scaled to the actuators' range."""
        return self.model.nu

    def goal_starts(self) -> StartSet:
        """The list [s^g] that Algorithm 1 begins with, capacity 1, at rest."""
        qpos = jnp.asarray(self.goal_state, jnp.float32)[None]
        return StartSet(qpos=qpos, qvel=jnp.zeros((1, self.model.nv)), valid=jnp.ones(1, bool))

    def reset(self, starts: StartSet) -> PhysicsState:
        """Simulations that begin in the given starts; B is their capacity."""
        return reset(starts.qpos, starts.qvel)

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        """One physics step with actions (B, nu), clipped to [-1, 1] and scaled to the actuators' range."""
        low, high = jnp.asarray(self.model.actuator_ctrlrange, jnp.float32).T
        ctrl = low + (jnp.clip(action, -1.0, 1.0) + 1.0) * 0.5 * (high - low)
        return self.engine.step(state, ctrl)

    def snapshot(self, state: PhysicsState) -> Snapshot:
        """States with their kinematics, every leaf with a leading axis B."""
        return self._kinematics(state.qpos, state.qvel)

    def observe_batch(self, state: PhysicsState) -> Array:
        """Observations (B, obs_dim)."""
        return jax.vmap(self.observe)(self.snapshot(state))

    def feasible_starts(self) -> StartSet:
        """S^0, the feasible starts that evaluation draws from; all valid.

        Raises:
            FileNotFoundError: no set was generated for this task yet; says how to.
            StartsFileError: the file is damaged, or made for another model.
        """
        if not self.feasible_file.exists():
            raise FileNotFoundError(
                f"{self.feasible_file}: no feasible starts; make them with python -m rcg_jax.feasible task={self.name}"
            )
        qpos = jnp.asarray(load_starts(self.feasible_file))
        if qpos.shape[1] != self.model.nq:
            raise StartsFileError(
                f"{self.feasible_file}: {qpos.shape[1]} positions per start, {self.name} has {self.model.nq}"
            )
        return StartSet(qpos=qpos, qvel=jnp.zeros((len(qpos), self.model.nv)), valid=jnp.ones(len(qpos), bool))
