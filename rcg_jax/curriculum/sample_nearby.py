"""Procedure 1: new starts near given ones, by Brownian walks in action space (section 4.2)."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config.settings import SELECTIONS
from rcg_jax.curriculum.settle import num_settle_candidates, settled
from rcg_jax.curriculum.spread import spread_starts
from rcg_jax.physics.jit import jit
from rcg_jax.tasks.base import Task
from rcg_jax.types import PhysicsState, StartSet, concatenate, sample_starts

#: Noise processes of a walk, see :func:`brownian_walks`: (a_(t-1), neutral action, eps_t) -> a_t.
_NEXT_ACTION: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "white": lambda last, neutral, eps: neutral + eps,
    "integrated": lambda last, neutral, eps: last + eps,
}


def brownian_walks(
    task: Task,
    key: Array,
    seeds: StartSet,
    *,
    num_walks: int,
    num_snapshots: int,
    walk_length: Array | int,
    noise_std: float,
    noise: str,
) -> StartSet:
    """States visited by random walks that begin at rest in uniformly drawn seeds.

    A walk ends where it leaves the feasible region (``task.is_feasible``, the kill region), fails, or turns
    non-finite; nothing from there on is kept. Passing through the goal does not end it.

    Args:
        task: task and physics.
        key: PRNG key.
        seeds: the seed states s_0; none valid gives no valid state.
        num_walks: W walks.
        num_snapshots: K states kept of each (static): after every step of walks of K steps; of longer ones densely at
            the beginning and ever more sparsely, at geometrically growing times, so that states at every distance
            from the seed are among them, also where the walk leaves a narrow place for good.
        walk_length: T_B >= K, physics steps of each walk; may be a traced value.
        noise_std: standard deviation of eps_t; 1 is the actuators' full range.
        noise: ``white``: a_t = n(s_0) + eps_t, where n is the task's neutral action: 0 for symmetric motors, as in the
            paper, and for a servo the pose that the walk begins in. ``integrated``: a_t = a_(t-1) + eps_t with
            a_0 = n(s_0) + eps_0, Brownian motion in action space. Both are clipped to the actuators' range when
            applied.

    Returns:
        K * W states at rest, with the activations that they were visited with; invalid where a walk had ended.

    Raises:
        ValueError: unknown noise.
    """
    if noise not in _NEXT_ACTION:
        raise ValueError(f"noise={noise}: must be one of {', '.join(_NEXT_ACTION)}")
    seed_key, noise_key = jax.random.split(key)
    s0 = sample_starts(seed_key, seeds, num_walks)
    neutral = task.neutral_action(s0.qpos)
    Carry = tuple[PhysicsState, Array, Array]

    def step(t: Array, carry: Carry) -> Carry:
        physics, action, alive = carry
        eps = noise_std * jax.random.normal(jax.random.fold_in(noise_key, t), action.shape)
        action = _NEXT_ACTION[noise](action, neutral, eps)
        moved = task.step(physics, action)
        s = task.snapshot(moved)
        alive = alive & jax.vmap(task.is_feasible)(s) & ~jax.vmap(task.is_failure)(s) & ~moved.bad
        return moved, action, alive

    def time_of(k: Array) -> Array:
        """After how many steps state k is kept. Of walks of K steps: k, every state, as in the paper."""
        geometric = jnp.round(jnp.float32(walk_length) ** (k / num_snapshots)).astype(jnp.int32)
        return jnp.where(k == 0, 0, jnp.maximum(k, geometric))

    def snapshot(carry: Carry, k: Array) -> tuple[Carry, StartSet]:
        carry = jax.lax.fori_loop(time_of(k), time_of(k + 1), step, carry)
        physics, _, alive = carry
        return carry, StartSet(qpos=physics.qpos, qvel=jnp.zeros_like(physics.qvel), valid=alive, act=physics.act)

    carry = (task.reset(s0), neutral, s0.valid)
    _, states = jax.lax.scan(snapshot, carry, jnp.arange(num_snapshots))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)


def visit_nearby(
    task: Task,
    key: Array,
    starts: StartSet,
    *,
    num_candidates: int,
    num_snapshots: int,
    walk_length: Array | int,
    walk_rounds: int,
    noise_std: float,
    noise: str,
) -> StartSet:
    """The candidates of :func:`sample_nearby`: ``starts``, and what walks from them visited.

    The walks have ``walk_length`` steps, ``num_snapshots`` states of each are kept (:func:`brownian_walks`); the other
    arguments are those of :func:`sample_nearby`. Not jitted.
    """
    walk_rounds, per_round = walk_counts(num_candidates, num_snapshots, walk_rounds)
    kept = per_round * num_snapshots

    def walk(collected: StartSet, x: tuple[Array, Array]) -> tuple[StartSet, None]:
        row, key = x
        visited = brownian_walks(
            task,
            key,
            collected,
            num_walks=per_round,
            num_snapshots=num_snapshots,
            walk_length=walk_length,
            noise_std=noise_std,
            noise=noise,
        )
        return jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, row, 0), collected, visited), None

    empty = jax.tree.map(lambda x: jnp.zeros((walk_rounds * kept, *x.shape[1:]), x.dtype), starts)
    rows = starts.capacity + kept * jnp.arange(walk_rounds)
    keys = key[None] if walk_rounds == 1 else jax.random.split(key, walk_rounds)
    return jax.lax.scan(walk, concatenate(starts, empty), (rows, keys))[0]


def walk_counts(num_candidates: int, num_snapshots: int, walk_rounds: int) -> tuple[int, int]:
    """Rounds, and walks in each of them, that keep at least M states together."""
    num_walks = -(-num_candidates // num_snapshots)
    rounds = min(walk_rounds, num_walks)
    return rounds, -(-num_walks // rounds)


def _sample_nearby(
    task: Task,
    key: Array,
    starts: StartSet,
    num_new: int = 200,
    *,
    num_candidates: int = 10_000,
    brownian_horizon: int = 50,
    walk_rounds: int = 10,
    noise_std: float = 1.0,
    noise: str = "integrated",
    selection: str = "random",
) -> StartSet:
    """Procedure 1, SampleNearby: ``num_new`` feasible start states near ``starts``. Jitted.

    It can be used inside ``jit``, ``vmap``, ``scan``, ``cond`` and functions that are differentiated with respect to
    something else; no gradient flows through physics.

    Args:
        task: from :func:`rcg_jax.make_task`; its engine runs the walks.
        key: ``jax.random.key(seed)``.
        starts: seed states, for instance ``task.goal_starts()``; at least one valid.
        num_new: N_new.
        num_candidates: M, states collected (rounded up to whole walks) before ``num_new`` of them are drawn.
        brownian_horizon: T_B [physics steps].
        walk_rounds: the walks are done in this many rounds, side by side within a round; those of a round begin in
            states drawn from the seeds and from all that earlier rounds visited. As many rounds as walks
            (M / T_B) is the paper's procedure to the letter, one after the other; 1 walks from the seeds only.
        noise_std: Sigma^(1/2); 1 is the actuators' full range.
        noise: ``white`` (the paper's text) or ``integrated`` (Brownian motion in action space).
        selection: which of the collected states are drawn: ``random``, uniformly (the paper); ``spread``, each as far
            as possible from those before it in ``task.grid_coordinates``, so that where walks linger does not count.

    Returns:
        StartSet of capacity ``num_new``, at rest; where the task has ``settle_steps``, only states that stay feasible
        for so long. The seeds themselves are among the candidates, as in the paper.

    Raises:
        ValueError: unknown noise or selection, a number that is no integer >= 1, or no noise.
    """
    counts = {"num_new": num_new, "num_candidates": num_candidates, "brownian_horizon": brownian_horizon}
    for name, value in {**counts, "walk_rounds": walk_rounds}.items():
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name}={value!r}: must be an integer >= 1")
    if not 0 < noise_std < float("inf"):
        raise ValueError(f"noise_std={noise_std!r}: must be a finite number > 0")
    if selection not in SELECTIONS:
        raise ValueError(f"selection={selection}: must be one of {', '.join(SELECTIONS)}")
    walk_key, draw_key = jax.random.split(key)
    starts = jax.lax.stop_gradient(task.with_act(starts))
    visited = visit_nearby(
        task,
        walk_key,
        starts,
        num_candidates=num_candidates,
        num_snapshots=brownian_horizon,
        walk_length=brownian_horizon,
        walk_rounds=walk_rounds,
        noise_std=noise_std,
        noise=noise,
    )
    num_drawn = num_settle_candidates(task, num_new)
    if selection == "random":
        chosen = sample_starts(draw_key, visited, num_drawn)
    else:
        chosen = spread_starts(draw_key, visited, task.grid_coordinates(visited.qpos), num_drawn)
    return settled(task, chosen, num_new)


sample_nearby = jit(
    _sample_nearby,
    static_argnames=(
        "task",
        "num_new",
        "num_candidates",
        "brownian_horizon",
        "walk_rounds",
        "noise_std",
        "noise",
        "selection",
    ),
)
