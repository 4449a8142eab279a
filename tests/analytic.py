"""Tasks without physics whose answers are known on paper; drop-in replacements of :class:`rcg_jax.tasks.Task`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

from rcg_jax.physics.engine import guard
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, Snapshot, StartSet


def make_starts(qpos: Any, *, nv: int = 1, valid: Any = None) -> StartSet:
    """A StartSet at rest from nested lists; all valid unless said otherwise."""
    qpos = jnp.asarray(qpos, jnp.float32)
    ok = jnp.ones(len(qpos), bool) if valid is None else jnp.asarray(valid, bool)
    return StartSet(qpos=qpos, qvel=jnp.zeros((len(qpos), nv)), valid=ok)


class AnalyticTask(Task):
    """A task whose ``step`` is a formula. It has no MuJoCo model and no kinematics."""

    nv = 1

    def __init__(self) -> None:
        self.engine, self.model = (cast(Any, SimpleNamespace(**it)) for it in ({"name": "analytic"}, {"na": 0}))

    @property
    def action_dim(self) -> int:
        return 1

    def neutral_action(self, qpos: Array) -> Array:
        return jnp.zeros((*qpos.shape[:-1], 1))

    def goal_starts(self) -> StartSet:
        return make_starts(self.goal_state[None], nv=self.nv)

    def snapshot(self, state: PhysicsState) -> Snapshot:
        nothing = jnp.zeros((state.qpos.shape[0], 1, 3))
        return Snapshot(
            qpos=state.qpos,
            qvel=state.qvel,
            xpos=nothing,
            xmat=jnp.zeros((state.qpos.shape[0], 1, 3, 3)),
            site_xpos=nothing,
            com=nothing[:, 0],
        )


class Line(AnalyticTask):
    """A point on a line has to come to 0.

    ``qpos`` is (x, clock, tag): the clock counts steps and the tag never changes, so that a state tells when and on
    which walk it was visited. The policy observes x and its velocity. Actions, clipped to [-1, 1], are velocities
    (``order=1``, x += gain * a) or accelerations (``order=2``, v += gain * a, x += gain * v).

    Args:
        horizon: T.
        gain: see above.
        order: 1 or 2.
        goal_radius: the goal is |x| < goal_radius.
        feasible_radius: S^0 is |x| < feasible_radius; :meth:`feasible_starts` is a grid on it, outside of the goal.
        fail_above: x beyond it is a failure.
        bad_above: steps that would lead x beyond it turn non-finite.
    """

    name = "line"

    def __init__(
        self,
        *,
        horizon: int = 40,
        gain: float = 0.05,
        order: int = 1,
        goal_radius: float = 0.05,
        feasible_radius: float = 1.0,
        fail_above: float = np.inf,
        bad_above: float = np.inf,
    ) -> None:
        super().__init__()
        self.horizon = horizon
        self.gain = gain
        self.order = order
        self.goal_radius = goal_radius
        self.feasible_radius = feasible_radius
        self.fail_above = fail_above
        self.bad_above = bad_above

    @property
    def goal_state(self) -> np.ndarray:
        return np.zeros(3)

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        a = jnp.clip(action, -1.0, 1.0)
        velocity = a if self.order == 1 else state.qvel + self.gain * a
        x = state.qpos[:, :1] + self.gain * velocity
        x = jnp.where(x > self.bad_above, jnp.nan, x)
        qpos = jnp.concatenate([x, state.qpos[:, 1:2] + 1.0, state.qpos[:, 2:]], axis=1)
        return guard(state, qpos, velocity, jnp.zeros_like(velocity))

    def observe(self, s: Snapshot) -> Array:
        return jnp.concatenate([s.qpos[:1], s.qvel])

    def distance(self, s: Snapshot) -> Array:
        return jnp.abs(s.qpos[0])

    def is_goal(self, s: Snapshot) -> Array:
        return self.distance(s) < self.goal_radius

    def is_feasible(self, s: Snapshot) -> Array:
        return self.distance(s) < self.feasible_radius

    def can_fail(self) -> bool:
        return bool(np.isfinite(self.fail_above))

    def is_failure(self, s: Snapshot) -> Array:
        return s.qpos[0] > self.fail_above

    def feasible_starts(self) -> StartSet:
        x = np.linspace(self.goal_radius, 0.99 * min(self.feasible_radius, self.fail_above, self.bad_above), 100)
        x = np.concatenate([-x, x])
        return make_starts(np.stack([x, 0 * x, 0 * x], axis=1))


class ExactLine(Line):
    """A :class:`Line` that draws its feasible starts, |x| < ``feasible_radius``, itself."""

    name = "exact_line"

    def sample_feasible(self, key: Array, num: int) -> StartSet:
        x = jax.random.uniform(key, (num, 1), minval=-self.feasible_radius, maxval=self.feasible_radius)
        return StartSet(qpos=jnp.pad(x, ((0, 0), (0, 2))), qvel=jnp.zeros((num, self.nv)), valid=jnp.ones(num, bool))


class Coin(AnalyticTask):
    """Every step is a toss, decided by the raw action alone, the same for every policy with actions ~ N(0, 1).

    ``qpos`` is (number of the start, outcome of the last toss, steps so far), and the policy observes number and steps.
    A toss is a success (outcome 1) with the start's probability, else maybe a failure (-1) or non-finite physics, else
    nothing (0) and the episode goes on, at most up to the horizon.

    Args:
        success: probability of a success in one step, for each start.
        failure, nonfinite: probabilities of those, the same for every start.
        horizon: T.
    """

    name = "coin"

    def __init__(
        self, success: list[float], *, failure: float = 0.0, nonfinite: float = 0.0, horizon: int = 20
    ) -> None:
        super().__init__()
        self.horizon = horizon
        self._per_step = np.array(success), failure, nonfinite
        # From the top: success. From the bottom: failure, then non-finite.
        self._success_above = jnp.asarray(stats.norm.isf(success), jnp.float32)
        self._failure_below = float(stats.norm.ppf(failure))
        self._nonfinite_below = float(stats.norm.ppf(failure + nonfinite))

    @property
    def success_probability(self) -> np.ndarray:
        """R(pi, s_0) of each start: an episode of at most T tosses ends with a success."""
        success, failure, nonfinite = self._per_step
        ends = success + failure + nonfinite
        return success / ends * (1 - (1 - ends) ** self.horizon)

    @property
    def goal_state(self) -> np.ndarray:
        return np.array([0.0, 1.0, 0.0])

    def starts(self, valid: Any = None) -> StartSet:
        """One start for each success probability."""
        number = np.arange(len(self._success_above), dtype=np.float32)
        return make_starts(np.stack([number, 0 * number, 0 * number], axis=1), valid=valid)

    def feasible_starts(self) -> StartSet:
        return self.starts()

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        toss = action[:, 0]
        number = state.qpos[:, 0]
        success = toss > self._success_above[number.astype(jnp.int32)]
        failure = toss < self._failure_below
        outcome = success.astype(jnp.float32) - failure
        outcome = jnp.where(~failure & (toss < self._nonfinite_below), jnp.nan, outcome)
        qpos = jnp.stack([number, outcome, state.qpos[:, 2] + 1.0], axis=1)
        return guard(state, qpos, state.qvel, state.qacc_warmstart)

    def observe(self, s: Snapshot) -> Array:
        return jnp.stack([s.qpos[0], s.qpos[2]])

    def distance(self, s: Snapshot) -> Array:
        return 1.0 - s.qpos[1]

    def is_goal(self, s: Snapshot) -> Array:
        return s.qpos[1] > 0.5

    def is_feasible(self, s: Snapshot) -> Array:
        return jnp.ones((), bool)

    def is_failure(self, s: Snapshot) -> Array:
        return s.qpos[1] < -0.5
