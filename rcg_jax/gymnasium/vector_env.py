"""A task as a Gymnasium vector environment, for trainers other than ours.

``make_vec(task, num_envs)`` steps all environments in one compiled program over the batched physics; nothing loops over
environments in Python. Episodes begin in feasible starts, as in evaluation (rho_0), in starts of one's own, or where a
:class:`rcg_jax.ReverseCurriculum` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jax import Array

from rcg_jax.gymnasium.ended_episodes import EndedEpisodes
from rcg_jax.methods.reverse_curriculum import ReverseCurriculum
from rcg_jax.physics.jit import jit
from rcg_jax.physics.kinematics import quaternions
from rcg_jax.rl.hold import decisions
from rcg_jax.rl.rollout import EnvState, Sampler, draw_from, observed, valid_first
from rcg_jax.sharding.devices import start_on_half_the_cores
from rcg_jax.tasks import Task
from rcg_jax.tasks.training import task_for_trainer
from rcg_jax.types import PhysicsState, StartSet, where_rows


@struct.dataclass
class Fresh:
    """What episodes begin with, C of them.

    Attributes:
        physics: simulations in the starts.
        obs: (C, obs_dim) their observations.
        rows: (C,) int32, row numbers, those of valid starts first.
        count: () int32, how many are valid.
    """

    physics: PhysicsState
    obs: Array
    rows: Array
    count: Array

    def draw(self, key: Array, num: int) -> Array:
        """Rows of ``num`` valid starts, independent and uniform."""
        return draw_from(key, self.rows, self.count, (num,)).astype(jnp.int32)

    def at(self, rows: Array) -> tuple[PhysicsState, Array]:
        """Simulations and observations of these rows."""
        return jax.tree.map(lambda x: x[rows], (self.physics, self.obs))


def _prepare(task: Task, starts: StartSet) -> Fresh:
    physics, obs = observed(task, starts)
    return Fresh(physics=physics, obs=obs, rows=valid_first(starts).astype(jnp.int32), count=starts.count())


class TaskVectorEnv(gymnasium.vector.VectorEnv):
    """B environments of one task.

    Observations (B, obs_dim) float32 are raw, as :meth:`rcg_jax.Task.observe` gives them; actions (B, nu) in [-1, 1]
    are held for ``action_repeat`` physics steps, so an episode has at most ``ceil(T / action_repeat)`` actions. The
    reward is 1 for the action that reaches the goal set, which ends the episode, and 0 otherwise (section 3.2).
    ``terminated``: goal, failure, or numbers that turned non-finite; ``truncated``: the horizon T was reached.

    Autoreset mode is ``SAME_STEP``: the observation after an episode's last action is that of the next episode's start;
    ``infos["final_obs"]`` has the last one in the rows where ``infos["_final_obs"]`` is True. ``infos["success"]`` (B,)
    bool says which actions reached the goal. Of the episode of each action, ``infos["steps"]`` (B,) int are its physics
    steps so far, ``infos["start"]`` (B,) int the row of ``starts`` that it began in, -1 for a state given to ``reset``.

    With a curriculum, ``starts`` are its rho_i. In each of its iterations the first episodes of every environment, as
    many as of every other, are reported; when all of these have ended, the next iteration begins.

    Attributes:
        task: task and physics.
        starts: where episodes begin, drawn uniformly; may be replaced at any time by :meth:`set_starts`.
        curriculum: where the starts come from, if from one.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 - Gymnasium's contract

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        starts: StartSet,
        action_repeat: int = 1,
        curriculum: ReverseCurriculum | None = None,
    ) -> None:
        """See :func:`make_vec`."""
        self.curriculum = curriculum
        self.task, self.num_envs, self._action_repeat = task, num_envs, action_repeat
        infinite = np.full(task.obs_dim, np.inf, np.float32)
        one = np.ones(task.action_dim, np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-infinite, infinite, dtype=np.float32)
        self.single_action_space = gymnasium.spaces.Box(-one, one, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = None
        self.spec = gymnasium.envs.registration.EnvSpec(
            f"rcg_jax/{task.name}-v0", max_episode_steps=decisions(task.horizon, action_repeat)
        )
        # The actions come from outside: the sampler's "noise" is the action itself.
        sampler = Sampler(task=task, act=lambda obs, action: action, repeat=action_repeat)
        emitters = task.engine.fusion_emitters
        self._prepare = jit(lambda starts: _prepare(task, starts), fusion_emitters=emitters)
        self._draw = jit(lambda key, fresh: fresh.draw(key, num_envs))
        self._begin = jit(_begin, fusion_emitters=emitters)
        self._step = jit(lambda *args: _step(sampler, *args), fusion_emitters=emitters)
        self._env: EnvState | None = None
        self._key = jax.random.key(0)
        self._set_starts(starts)
        self._ended = EndedEpisodes(curriculum, num_envs) if curriculum else None

    @property
    def action_repeat(self) -> int:
        """Physics steps per action."""
        return self._action_repeat

    def set_starts(self, starts: StartSet) -> None:
        """Draws the episodes that begin from now on from ``starts``, at least one of them valid.

        Sets of the same capacity share one compiled program.

        Raises:
            ValueError: none is valid, or the starts are those of a curriculum.
        """
        if self.curriculum is not None:
            raise ValueError("starts: come from the curriculum")
        self._set_starts(starts)

    def _follow(self) -> None:
        """Takes the curriculum's starts, where it has gone on: here, by hand, or from a file."""
        if self._ended and self.starts is not self._ended.curriculum.starts:
            self._set_starts(self._ended.curriculum.starts)
            self._ended.begin(np.full(self.num_envs, self._env is not None))

    def _set_starts(self, starts: StartSet) -> None:
        if not isinstance(starts, StartSet):
            raise ValueError(f"starts: must be a rcg_jax.StartSet, not {type(starts).__name__}")
        if (width := np.shape(starts.qpos)[1:]) != (wanted := np.shape(self.task.goal_state)):
            raise ValueError(f"starts: must have positions of shape {wanted}, not {width}: of another task?")
        if not bool(np.any(starts.valid)):
            raise ValueError("starts: none of them is valid")
        self.starts = starts
        self._fresh: Fresh = self._prepare(starts)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode in every environment.

        Args:
            seed: of the starts drawn from now on, in all environments together; of a list, all seeds count.
            options: ``qpos`` (B, nq) and, at rest by default, ``qvel`` (B, nv) and ``act`` (B, na), the activations, if
                there are any: states to begin in instead of drawn ones; ``reset_mask`` (B,) bool: the
                environments to reset, all by default.

        Raises:
            ValueError: an option that is not known, or of the wrong shape.
        """
        self._follow()
        if seed is not None:
            seeds: list[Any] = list(seed) if np.ndim(seed) else [seed]  # type: ignore[arg-type]
            fine = all(s is None or (isinstance(s, int | np.integer) and s >= 0) for s in seeds)
            if len(seeds) not in (1, self.num_envs) or not fine:
                raise ValueError(
                    f"seed={seed}: must be an integer >= 0, or one for each of the {self.num_envs} environments"
                )
            words = np.random.SeedSequence([s or 0 for s in seeds])
            self._key = jax.random.key(int(words.generate_state(1)[0]))
            self._np_random, self._np_random_seed = np.random.default_rng(words), -1
        self._key, key = jax.random.split(self._key)
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask: must be ({self.num_envs},) bool, not {mask.shape} {mask.dtype}")
        if self._env is None and not mask.all():
            raise ValueError("reset_mask: the first reset is of all environments")
        if {"qpos", "qvel", "act"} & set(options):
            fresh, rows = self._prepare(self._given(options)), np.arange(self.num_envs, dtype=np.int32)
            starts = np.full_like(rows, -1)
        else:
            fresh = self._fresh
            starts = rows = self._draw(key, fresh)
        if options:
            raise ValueError(f"options: {', '.join(options)} unknown; known: qpos, qvel, act, reset_mask")
        self._env = self._begin(fresh, rows, starts, jnp.asarray(mask), self._env)
        if self._ended:
            self._ended.old &= ~mask
        return np.array(self._env.obs), {"start": np.asarray(self._env.start)}

    def _given(self, options: dict[str, Any]) -> StartSet:
        """The states in ``options``, which they are taken out of."""
        model, n = self.task.model, self.num_envs
        shapes = {"qpos": (n, model.nq), "qvel": (n, model.nv), "act": (n, model.na)}
        if "act" in options and not model.na:
            raise ValueError("act: the model has no activations")
        if "qpos" not in options:
            raise ValueError(f"{'qvel' if 'qvel' in options else 'act'}: needs qpos, too")
        given = {"qvel": np.zeros(shapes["qvel"])} | {name: options.pop(name) for name in shapes if name in options}
        for name in given:
            shape = shapes[name]
            value = np.asarray(given[name], float)
            if value.shape != shape:
                raise ValueError(f"{name}: must have the shape {shape}, not {value.shape}")
            if not (np.abs(value) < mujoco.mjMAXVAL).all():
                raise ValueError(f"{name}: must be finite numbers that MuJoCo can simulate")
            given[name] = jnp.asarray(self._normalised(value) if name == "qpos" else value, jnp.float32)
        return StartSet(**given, valid=jnp.ones(self.num_envs, bool))

    def _normalised(self, qpos: np.ndarray) -> np.ndarray:
        """Positions (B, nq) with quaternions of length 1, as MuJoCo has them in its steps."""
        qpos = qpos.copy()
        for place in quaternions(self.task.model).values():
            quat = qpos[:, place]
            length = np.linalg.norm(quat, axis=1, keepdims=True)
            if (length < mujoco.mjMINVAL).any():
                raise ValueError(f"qpos: the quaternion at [{place.start}:{place.stop}] has length 0")
            quat /= length
        return qpos

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One action in every environment; see the class for what is returned.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            ValueError: actions of the wrong shape, or not finite.
        """
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        actions = np.asarray(actions, np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions: must have the shape {self.action_space.shape}, not {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError(f"actions: NaN or infinite in rows {np.flatnonzero(~np.isfinite(actions).all(axis=1))}")
        self._follow()
        self._env, self._key, out = self._step(self._env, self._key, self._fresh, actions)
        obs, final_obs, success, terminal, done, start, steps = jax.device_get((self._env.obs, *out))
        infos = {"start": start, "success": success, "steps": steps}
        if done.any():
            infos |= {"final_obs": final_obs, "_final_obs": done}
            if self._ended and self._ended.add(done, start, success, steps):
                self._follow()
        return np.array(obs), success.astype(np.float64), terminal, done & ~terminal, infos


def _begin(fresh: Fresh, rows: Array, starts: Array, mask: Array, env: EnvState | None) -> EnvState:
    """Episodes in ``rows`` of ``fresh`` where ``mask``; elsewhere those under way in ``env`` go on."""
    n = len(rows)
    physics, obs = fresh.at(rows)
    new = EnvState(physics=physics, obs=obs, start=starts, age=jnp.zeros(n, jnp.int32), counted=jnp.ones(n, bool))
    if env is None:
        return new
    return where_rows(mask, new, env)


def _step(
    sampler: Sampler, env: EnvState, key: Array, fresh: Fresh, actions: Array
) -> tuple[EnvState, Array, tuple[Array, ...]]:
    """One action in every environment: what follows, a new key, and what :meth:`TaskVectorEnv.step` returns of it."""
    key, draw_key = jax.random.split(key)
    rows = fresh.draw(draw_key, len(actions))
    env, t = sampler.step(env, actions, (*fresh.at(rows), rows), jnp.bool_(True))
    return env, key, (t.next_obs, t.success, t.terminal, t.done, t.start, t.age)


def make_vec(
    task: str | Task,
    num_envs: int,
    *,
    starts: StartSet | None = None,
    curriculum: ReverseCurriculum | None = None,
    action_repeat: int | None = None,
    engine: str = "native",
) -> TaskVectorEnv:
    """A :class:`TaskVectorEnv`.

    Args:
        task: as of ``task=`` on the command line, or a task that is built.
        num_envs: B.
        starts: where episodes begin; by default the task's feasible starts S^0, that is rho_0.
        curriculum: instead of ``starts``: of the same task; it is told how episodes end, and goes on by itself.
        action_repeat: physics steps per action; by default what the task trains with.
        engine: physics, of a task given by name.

    Raises:
        ValueError: no such task or engine, a number that is not positive, both ``starts`` and ``curriculum``, or a
            curriculum of another task.
        FileNotFoundError: the task has no feasible starts, and none are given.
    """
    if not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ValueError(f"num_envs={num_envs!r}: must be an integer >= 1")
    if engine == "native":
        start_on_half_the_cores()  # the others are MuJoCo's
    task, repeat = task_for_trainer(task, engine, action_repeat)
    if curriculum is not None:
        if starts is not None:
            raise ValueError("starts, curriculum: only one of them")
        if type(curriculum.task) is not type(task):
            raise ValueError(f"curriculum: is of task {curriculum.task.name}, not {task.name}")
        starts = curriculum.starts
    elif starts is None:
        starts = task.feasible_starts()
    return TaskVectorEnv(task, num_envs, starts=starts, action_repeat=repeat, curriculum=curriculum)
