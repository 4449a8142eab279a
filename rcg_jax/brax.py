"""A task as a Brax environment, so that Brax's PPO and SAC train on it under jit; on any engine.

    env = TaskEnv("ring_peg", engine="native")
    ppo.train(environment=env, episode_length=env.episode_length, num_timesteps=1_000_000, num_envs=64)

Brax 0.14.2 calls ``jax.device_put_replicated``, which JAX 0.10 no longer has: docs/trainers.md has a substitute.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array

from rcg_jax.rl.hold import active_mask, decisions, hold
from rcg_jax.rl.rollout import draw_from, observed, valid_first
from rcg_jax.tasks import Task
from rcg_jax.tasks.training import task_for_trainer
from rcg_jax.types import Snapshot, StartSet, finite


class TaskEnv(Env):
    """One environment; Brax vmaps it, ends episodes after ``episode_length`` actions, and begins them again.

    Reward 1 and ``done`` for the action that reaches the goal set (section 3.2), ``done`` also for a failure or numbers
    that turned non-finite; ``metrics["success"]``. Actions in [-1, 1] are held for ``action_repeat`` physics steps: an
    episode of T physics steps has ``ceil(task.horizon / action_repeat)`` of them. Brax's own wrapper begins every
    episode of an environment in the start that it was reset to.
    """

    def __init__(
        self,
        task: str | Task,
        *,
        starts: StartSet | None = None,
        action_repeat: int | None = None,
        engine: str = "mjx",
    ) -> None:
        """A task as an environment.

        Args:
            task: as of ``task=`` on the command line, or a task that is built.
            starts: where ``reset`` draws from; by default the feasible starts S^0, that is rho_0.
            action_repeat: physics steps per action; by default what the task trains with.
            engine: physics, of a task given by name.

        Raises:
            ValueError: no such task or engine, no valid start, or action_repeat < 1.
            FileNotFoundError: the task has no feasible starts, and none are given.
        """
        self.task, self.action_repeat = task_for_trainer(task, engine, action_repeat)
        self.starts = self.task.feasible_starts() if starts is None else starts
        if not bool(self.starts.valid.any()):
            raise ValueError("starts: none of them is valid")
        self._rows = valid_first(self.starts)

    def reset(self, rng: Array) -> State:
        row = draw_from(rng, self._rows, self.starts.count(), (1,))
        physics, obs = observed(self.task, self.starts.take(row))
        zero = jnp.zeros(())
        return State(_alone(physics), obs[0], zero, zero, metrics={"success": zero}, info={})

    def step(self, state: State, action: Array) -> State:
        task, before = self.task, jax.tree.map(lambda x: x[None], state.pipeline_state)

        def look(s: Snapshot) -> tuple[Array, Array]:
            return task.is_goal(s), task.is_failure(s) | ~finite(task.distance(s)[None])[1]

        physics, s, ((goal, failure), bad) = hold(task, before, action[None], self.action_repeat, look)
        obs, seen = finite(jax.vmap(task.observe)(s))
        bad = bad.at[-1].set(bad[-1] | ~seen) | before.bad | ~jnp.isfinite(action).all()
        goal &= ~bad
        live = active_mask(goal | failure | bad, jnp.full(1, self.action_repeat))
        success = jnp.any(live & goal).astype(jnp.float32)
        done = jnp.any(live & (goal | failure | bad)).astype(jnp.float32)
        return state.replace(  # type: ignore[attr-defined, no-any-return]
            pipeline_state=_alone(physics),
            obs=obs[0],
            reward=success,
            done=done,
            metrics={**state.metrics, "success": success},
        )

    @property
    def episode_length(self) -> int:
        """T in actions, as Brax's trainers count it."""
        return decisions(self.task.horizon, self.action_repeat)

    @property
    def observation_size(self) -> int:
        return self.task.obs_dim

    @property
    def action_size(self) -> int:
        return self.task.action_dim

    @property
    def backend(self) -> str:
        return self.task.engine.name


def _alone(batch: Any) -> Any:
    return jax.tree.map(lambda x: x[0], batch)
