"""What a task is: a model, one goal state, and a few functions of a state (paper, sections 3.2 and 3.3)."""

from __future__ import annotations

import abc
import dataclasses
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from rcg_jax.config import names
from rcg_jax.io.assets import DATA
from rcg_jax.io.starts_file import hash_starts, load_states
from rcg_jax.physics import make_engine
from rcg_jax.physics.engine import Engine, UnsupportedModelError, reset
from rcg_jax.physics.kinematics import make_kinematics
from rcg_jax.physics.native import NativeEngine
from rcg_jax.physics.unsupported import hidden_state
from rcg_jax.sharding.devices import each_its_own
from rcg_jax.tasks.actuators import give_ranges, neutral_act, neutral_action
from rcg_jax.tasks.keyframes import place_mocap
from rcg_jax.types import ObservationPart, PhysicsState, Snapshot, StartSet, observation_parts, sample_starts

AnyArray = TypeVar("AnyArray", np.ndarray, Array)


class Task(abc.ABC):
    """A goal-oriented task. Subclasses give the class attributes and the functions of one :class:`Snapshot`.

    The functions take a single state, without batch axis, in jnp; the pipeline vmaps them. Paths may be relative to the
    folder of the file that defines the class.

    Attributes:
        name: registered name; by default the class's own.
        xml: path of the MJCF file.
        horizon: T, physics steps per episode.
        settle_steps: physics steps of :meth:`neutral_action` for which a state at rest has to stay feasible to be a new
            start of SampleNearby, and to be found by a search for S^0 unless ``search`` says otherwise; 0 where every
            feasible state at rest stays so. Self-play's and exact samplers' starts are not checked.
        feasible_file: npz with the feasible starts S^0, written by ``python -m rcg_jax.feasible``; by default
            ``<file>.<ClassName>.npz`` beside the class's file, for tasks of this package ``data/<name>.npz``. It is not
            inherited: another model, or another region, has other feasible starts.
        search: settings of ``python -m rcg_jax.feasible`` that differ for this task, by name.
        training: settings of training that differ for this task, by dotted name (``policy.action_repeat``); those of
            the classes that it extends hold, too (:func:`rcg_jax.tasks.training.task_settings`).
        observation: the parts of an observation in order, each a :class:`rcg_jax.types.ObservationPart` (name,
            size, unit, source) or such a tuple, for the cards of trained policies; empty: one part without a unit.
        point_name: what :meth:`point` is, in a report's words, such as ``the tip of the key``.
        part_names: what the subsets of :meth:`composition` are called in reports, by name, where that is not clear.
    """

    name: str
    xml: Path
    feasible_file: Path
    horizon: int = 500
    settle_steps: int = 0
    search: Mapping[str, Any] = MappingProxyType({})
    training: Mapping[str, Any] = MappingProxyType({})
    observation: Sequence[tuple[Any, ...]] = ()
    point_name: str = ""
    part_names: Mapping[str, str] = MappingProxyType({"at_goal": "at the goal"})

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        own, source = vars(cls), cls.source()
        folder = source.parent if source else Path.cwd()
        cls.name = own.get("name", cls.__name__)
        if "observe" in own:
            cls.observation = own.get("observation", ())  # another observation has other parts
        if {"point", "distance"} & set(own):
            cls.point_name = own.get("point_name", "")  # another point
        if isinstance(own.get("xml"), str | Path):
            cls.xml = folder / cls.xml
        default: str | Path = f"{source.stem}.{cls.__name__}.npz" if source else f"{cls.__name__}.npz"
        if cls.__module__.split(".")[0] == __name__.split(".")[0]:
            default = DATA / f"{cls.name}.npz"
        starts = own.get("feasible_file", default)
        if isinstance(starts, str | Path):  # it may be a property
            cls.feasible_file = folder / starts

    @classmethod
    def source(cls) -> Path | None:
        """The file that defines the class; None in an interactive session."""
        file = getattr(sys.modules.get(cls.__module__), "__file__", None)
        return Path(file).resolve() if file else None

    @classmethod
    def spelled(cls) -> str:
        """What ``task=`` has to say on the command line for this class."""
        source = cls.source()
        if cls.name in names.TASKS or source is None:
            return cls.name
        inside = source.is_relative_to(Path.cwd())
        return f"{source.relative_to(Path.cwd()) if inside else source}:{cls.__qualname__}"

    def __init__(self, engine: str = "mjx") -> None:
        """Loads the model and binds it to a physics engine, one of :data:`rcg_jax.physics.ENGINES`."""
        self.model = self.make_model()
        # No silent reset of unstable states: the engines detect and report them.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # Which bodies sleep is state of MuJoCo's that depends on the past; without it, a step is the exact one.
        self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        give_ranges(self.model)
        if self.model.nmocap and self.model.nkey:
            place_mocap(self.model, self._goal_positions())
        self._bind(engine)

    def _bind(self, engine: str) -> None:
        self.engine = make_engine(engine, self.model)
        self._kinematics = make_kinematics(self.model)

    def with_engine(self, engine: Engine) -> Self:
        """This task on another physics engine, which simulates its model, or variants of it."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), engine=engine)
        return other

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: all but what the engine and compiled programs are made of, which is made again."""
        made = {"engine", "_kinematics", "_neutral_action", "_neutral_act"}
        kept = {name: value for name, value in vars(self).items() if name not in made}
        return kept | {"engine": self.engine.name, "_variants": getattr(self.engine, "variants", ())}

    def __setstate__(self, state: dict[str, Any]) -> None:
        variants = state.pop("_variants", ())
        vars(self).update(state)
        self._bind(state["engine"])
        if variants:
            self.engine = NativeEngine(self.model, variants)

    def make_model(self) -> mujoco.MjModel:
        """The compiled model, by default of :meth:`make_spec`."""
        return self.make_spec().compile()

    def make_spec(self) -> mujoco.MjSpec:
        """The model, to be edited or saved: the MJCF as it stands, unless a task adds to it."""
        return mujoco.MjSpec.from_file(str(self.xml))

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

    def can_fail(self) -> bool:
        """Whether an episode can end by :meth:`is_failure`: whether the task has its own."""
        return type(self).is_failure is not Task.is_failure

    def composition(self, s: Snapshot) -> dict[str, Array]:
        """Named subsets of S^0 whose shares a file of feasible starts reports, {name: () bool}."""
        return {"at_goal": self.is_goal(s)}

    def point(self, s: Snapshot) -> Array | None:
        """The point (3,) [m] in the world that a run's report draws for each start, where it comes to the goal.

        None, the default: the report finds the site or body whose distance to the model's site ``goal`` is the task's
        distance, or else whose way from its place in the goal state goes best with that distance.
        """
        return None

    def grid_coordinates(self, qpos: AnyArray) -> AnyArray:
        """Coordinates (C, d) [rad, m] of positions (C, nq), of NumPy or JAX, whose grid cells thin S^0."""
        return qpos

    @cached_property
    def obs_dim(self) -> int:
        """Length of an observation."""
        return jax.eval_shape(self.observe_batch, jax.eval_shape(lambda: self.reset(self.goal_starts()))).shape[-1]

    def observation_parts(self) -> tuple[ObservationPart, ...]:
        """The parts of an observation, as :attr:`observation` says.

        Raises:
            ValueError: their sizes do not add up to the length of an observation.
        """
        return observation_parts(self.observation, self.obs_dim)

    @property
    def action_dim(self) -> int:
        """nu, number of actuators; actions span [-1, 1] each and are scaled to the actuators' range."""
        return self.model.nu

    def neutral_action(self, qpos: Array) -> Array:
        """The actions (B, nu) in [-1, 1] that leave states at rest, with positions (B, nq), to themselves.

        Walks begin with them, states settle under them. By default those of
        :func:`rcg_jax.tasks.actuators.neutral_control`; a task may know better, in jnp.
        """
        return self._neutral_action(qpos)

    def neutral_act(self, qpos: Array) -> Array:
        """Activations (B, na) of states at rest of which only the positions (B, nq) are known, such as the goal state.

        By default those of :func:`rcg_jax.tasks.actuators.neutral_act`, which keep servos there.
        """
        return self._neutral_act(qpos)

    def _goal_positions(self) -> np.ndarray:
        with jax.ensure_compile_time_eval():  # the goal state may be computed in jnp, and this asked for in a jit
            return np.asarray(self.goal_state, float)

    @cached_property
    def _neutral_action(self) -> Callable[[Array], Array]:
        return neutral_action(self.model, self._goal_positions())

    @cached_property
    def _neutral_act(self) -> Callable[[Array], Array]:
        return neutral_act(self.model, self._goal_positions())

    def at_rest(self, qpos: Array, act: Array | None = None) -> StartSet:
        """Starts at rest, all of them valid, with positions (C, nq) and activations (C, na), or the neutral ones."""
        return self.with_act(StartSet.at_rest(qpos, self.model.nv, act))

    def with_act(self, starts: StartSet) -> StartSet:
        """The starts, with neutral activations where they lack the ones that the model has."""
        if starts.act is not None or not self.model.na:
            return starts
        return dataclasses.replace(starts, act=self.neutral_act(starts.qpos))

    def goal_starts(self) -> StartSet:
        """The list [s^g] that Algorithm 1 begins with, capacity 1, at rest."""
        return self.at_rest(jnp.asarray(self.goal_state, jnp.float32)[None])

    def reset(self, starts: StartSet) -> PhysicsState:
        """Simulations that begin in the given starts; B is their capacity."""
        starts = self.with_act(starts)
        return reset(starts.qpos, starts.qvel, starts.act)

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        """One physics step with actions (B, nu), clipped to [-1, 1] and scaled to the actuators' range.

        Raises:
            UnsupportedModelError: the model has state besides positions, velocities and activations.
        """
        return each_its_own(self.engine.step)(state, self._ctrl(action))

    def steps(self, state: PhysicsState, action: Array, num: int) -> PhysicsState:
        """``num`` physics steps (static) under the same actions: the states after each, leaves (B, num, ...)."""
        together = getattr(self.engine, "steps", None)
        if together is not None and type(self).step is Task.step:
            return each_its_own(partial(together, num=num))(state, self._ctrl(action))

        def step(state: PhysicsState, _: None) -> tuple[PhysicsState, PhysicsState]:
            after = self.step(state, action)
            return after, after

        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), jax.lax.scan(step, state, length=num)[1])

    def _ctrl(self, action: Array) -> Array:
        """Controls (B, nu) of actions."""
        if what := hidden_state(self.model):
            raise UnsupportedModelError(f"task={self.name}: has a model with {what}")
        low, high = jnp.asarray(self.model.actuator_ctrlrange, jnp.float32).T
        return low + (jnp.clip(action, -1.0, 1.0) + 1.0) * 0.5 * (high - low)

    def snapshot(self, state: PhysicsState) -> Snapshot:
        """States with their kinematics, every leaf with a leading axis B."""
        return dataclasses.replace(self._kinematics(state.qpos, state.qvel), act=state.act)

    def observe_batch(self, state: PhysicsState) -> Array:
        """Observations (B, obs_dim)."""
        return jax.vmap(self.observe)(self.snapshot(state))

    def feasible_starts(self) -> StartSet:
        """S^0, the feasible starts that evaluation draws from, of ``feasible_file``; all valid.

        A task with an exact sampler that has no such file draws 10,000 of them, always the same.

        Raises:
            FileNotFoundError: no set was generated for this task yet; says how to.
            StartsFileError: the file is damaged, or made for another model.
        """
        if self.feasible_file.exists():
            qpos, act = load_states(self.feasible_file, nq=self.model.nq, na=self.model.na, of=self.name)
            return self.at_rest(jnp.asarray(qpos), jnp.asarray(act) if self.model.na else None)
        if self.has_exact_sampler():
            return self.sample_feasible(jax.random.key(0), 10_000)
        command = shlex.join(["python", "-m", "rcg_jax.feasible", f"task={self.spelled()}"])
        raise FileNotFoundError(f"{self.feasible_file}: no feasible starts; make them with {command}")

    def starts_sha256(self) -> str:
        """Identity of :meth:`feasible_starts`, whose errors it raises: :func:`rcg_jax.io.starts_file.hash_starts`."""
        starts = self.feasible_starts()
        return hash_starts(np.asarray(starts.qpos), None if starts.act is None else np.asarray(starts.act))

    @classmethod
    def has_exact_sampler(cls) -> bool:
        """Whether :meth:`sample_feasible` draws from the region S^0 itself, not from a file of feasible starts."""
        return cls.sample_feasible is not Task.sample_feasible

    def sample_feasible(self, key: Array, num: int) -> StartSet:
        """``num`` starts of rho_0, uniform over S^0. Tasks whose S^0 is a simple region override this, in jnp.

        By default of :meth:`feasible_starts`, whose errors it raises, without replacement while there are enough.
        """
        return sample_starts(key, self.feasible_starts(), num)
