"""Procedure 1: new starts near given ones, by Brownian walks in action space (section 4.2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.base import PhysicsState, StartSet, concatenate, sample_rows, sample_starts
from rcg_jax.config import SELECTIONS
from rcg_jax.curriculum.spread import farthest_rows
from rcg_jax.physics.compile import jit
from rcg_jax.tasks.task import Task

#: Noise processes of a walk, see :func:`brownian_walks`.
NOISES = ("white", "integrated")


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
        num_snapshots: K states kept of each, equally spaced in time (static).
        walk_length: T_B >= K, physics steps of each walk; may be a traced value.
        noise_std: standard deviation of eps_t; 1 is the actuators' full range.
        noise: ``white``: a_t = eps_t. ``integrated``: a_t = a_(t-1) + eps_t with a_0 = eps_0, Brownian motion in
            action space. Both are clipped to the actuators' range when applied.

    Returns:
        K * W states at rest; invalid where a walk had ended.

    Raises:
        ValueError: unknown noise.
    """
    if noise not in NOISES:
        raise ValueError(f"noise={noise}: must be one of {', '.join(NOISES)}")
    seed_key, noise_key = jax.random.split(key)
    s0 = sample_starts(seed_key, seeds, num_walks)
    memory = 1.0 if noise == "integrated" else 0.0
    Carry = tuple[PhysicsState, Array, Array]

    def step(t: Array, carry: Carry) -> Carry:
        physics, action, alive = carry
        eps = noise_std * jax.random.normal(jax.random.fold_in(noise_key, t), action.shape)
        action = memory * action + eps
        moved = task.step(physics, action)
        s = task.snapshot(moved)
        alive = alive & jax.vmap(task.is_feasible)(s) & ~jax.vmap(task.is_failure)(s) & ~moved.bad
        return moved, action, alive

    def snapshot(carry: Carry, k: Array) -> tuple[Carry, StartSet]:
        carry = jax.lax.fori_loop(k * walk_length // num_snapshots, (k + 1) * walk_length // num_snapshots, step, carry)
        physics, _, alive = carry
        return carry, StartSet(qpos=physics.qpos, qvel=jnp.zeros_like(physics.qvel), valid=alive)

    carry = (task.reset(s0), jnp.zeros((num_walks, task.action_dim)), s0.valid)
    _, states = jax.lax.scan(snapshot, carry, jnp.arange(num_snapshots))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)


def propose_nearby(
    task: Task,
    key: Array,
    starts: StartSet,
    *,
    num_new: int,
    num_candidates: int,
    brownian_horizon: int,
    walk_length: Array | int,
    walk_rounds: int,
    noise_std: float,
    noise: str,
    selection: str,
) -> StartSet:
    """:func:`sample_nearby`, not jitted, for walks of ``walk_length`` steps of which ``brownian_horizon`` are kept."""
    if selection not in SELECTIONS:
        raise ValueError(f"selection={selection}: must be one of {', '.join(SELECTIONS)}")
    walk_key, sample_key = jax.random.split(key)
    num_walks = -(-num_candidates // brownian_horizon)
    walk_rounds = min(walk_rounds, num_walks)
    per_round = -(-num_walks // walk_rounds)
    kept = per_round * brownian_horizon

    def walk(collected: StartSet, x: tuple[Array, Array]) -> tuple[StartSet, None]:
        row, key = x
        visited = brownian_walks(
            task,
            key,
            collected,
            num_walks=per_round,
            num_snapshots=brownian_horizon,
            walk_length=walk_length,
            noise_std=noise_std,
            noise=noise,
        )
        return jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, row, 0), collected, visited), None

    room = jax.tree.map(lambda x: jnp.zeros((walk_rounds * kept, *x.shape[1:]), x.dtype), starts)
    rows = starts.capacity + kept * jnp.arange(walk_rounds)
    keys = walk_key[None] if walk_rounds == 1 else jax.random.split(walk_key, walk_rounds)
    collected, _ = jax.lax.scan(walk, concatenate(starts, room), (rows, keys))
    if selection == "random":
        return sample_starts(sample_key, collected, num_new)
    first = sample_rows(sample_key, collected, 1)[0]
    return collected.take(farthest_rows(task.grid_coordinates(collected.qpos), collected.valid, first, num_new))


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
        StartSet of capacity ``num_new``, at rest. The seeds themselves are among the candidates, as in the paper.

    Raises:
        ValueError: unknown noise or selection.
    """
    return propose_nearby(
        task,
        key,
        starts,
        num_new=num_new,
        num_candidates=num_candidates,
        brownian_horizon=brownian_horizon,
        walk_length=brownian_horizon,
        walk_rounds=walk_rounds,
        noise_std=noise_std,
        noise=noise,
        selection=selection,
    )


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
