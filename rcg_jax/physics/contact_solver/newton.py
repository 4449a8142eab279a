"""MuJoCo's Newton solver for many environments at once (the batch is the last axis).

MJX's solver runs every line search to its last permitted iteration and factors batches of 7 x 7 matrices one by one,
which is two thirds of a step of MJX on a CPU. Here an environment is done once a full Newton step no longer changes
which rows act: its cost is quadratic there, so the step was exact.

With the barriers, which keep XLA from computing intermediates anew for each of their users
(:mod:`rcg_jax.physics.jit`), the solver is three times faster on a CPU.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.physics.contact_solver.constraints import Rows

_barrier = jax.lax.optimization_barrier

#: A line search stops where the slope has fallen to this share of its start.
_FLAT = 1e-4


def multiply(matrix: Array, vector: Array) -> Array:
    """(M, V, B) times (V, B)."""
    return _total(matrix[:, k] * vector[k] for k in range(vector.shape[0]))


def solve_spd(matrix: Array, vector: Array) -> Array:
    """x in ``matrix`` x = ``vector`` for symmetric positive definite (V, V, B) and (V, B): plain elimination."""
    rows, rest = [], jnp.concatenate([matrix, vector[:, None]], axis=1)
    while rest.shape[0]:
        row = rest[0]
        rows.append(row)
        rest = _barrier(rest[1:, 1:] - rest[1:, :1] * (row[1:] / row[0]))
    found: list[Array] = []
    for row in reversed(rows):
        known = [a * x for a, x in zip(row[1:-1], found)]
        found.insert(0, _barrier((row[-1] - _total(known) if known else row[-1]) / row[0]))
    return jnp.stack(found)


def _total(terms: Iterable[Array]) -> Array:
    """Sum, written out term by term: a reduction over a leading axis would not use vector instructions on a CPU."""
    return functools.reduce(jnp.add, terms)


def solve(
    mass: Array, rows: Rows, free: Array, guess: Array, *, iterations: int, ls_iterations: int, tolerance: float
) -> tuple[Array, Array]:
    """Accelerations that minimise MuJoCo's cost, |qacc - free|_M^2 / 2 + sum_e D_e min(J_e qacc - ref_e, 0)^2 / 2.

    Args:
        mass: M, (V, V, B).
        rows: the constraints.
        free: (V, B) accelerations without constraints.
        guess: (V, B) where to start if that is better than ``free``.
        iterations, ls_iterations: maximum numbers of Newton steps, and of line search steps after the full step.
        tolerance: the gradient that counts as zero, relative to the trace of M.

    Returns:
        qacc (V, B), and the constraint forces in joint space (V, B).
    """
    if not rows.weight.shape[0]:
        return free, jnp.zeros_like(free)
    jacobian, weight, reference = _barrier(rows)
    transposed = jnp.swapaxes(jacobian, 0, 1)
    scale = 1 / _total(mass[k, k] for k in range(mass.shape[0]))

    def cost(qacc: Array, slack: Array) -> Array:
        away = qacc - free
        acting = jnp.minimum(slack, 0.0)
        return _total(away * multiply(mass, away)) + _total(weight * acting * acting)

    slack_guess, slack_free = (_barrier(multiply(jacobian, x) - reference) for x in (guess, free))
    use_guess = _barrier(cost(guess, slack_guess) < cost(free, slack_free))
    qacc = jnp.where(use_guess, guess, free)
    slack = jnp.where(use_guess, slack_guess, slack_free)

    def newton_step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        count, qacc, slack, done = state
        acting = _barrier(jnp.where(slack < 0, weight, 0.0))
        pull = _barrier(multiply(mass, qacc - free))
        gradient = _barrier(pull + multiply(transposed, acting * slack))
        pressed = _barrier(jacobian * acting[:, None])
        hessian = _barrier(mass + _total(p[:, None] * j for p, j in zip(pressed, jacobian)))
        step = -solve_spd(hessian, gradient)
        slope, heavy = _barrier((multiply(jacobian, step), multiply(mass, step)))
        same = ((slack + slope) < 0) == (slack < 0)
        exact = _barrier(functools.reduce(jnp.logical_and, same))
        length = _line_search(
            _total(step * pull),
            _total(step * heavy),
            slack=slack,
            slope=slope,
            weight=weight,
            steepness=jnp.abs(_total(step * gradient)),
            done=exact | done,
            most=ls_iterations,
        )
        small = scale * jnp.sqrt(_total(gradient * gradient)) < tolerance
        qacc = jnp.where(done, qacc, qacc + length * step)
        slack = jnp.where(done, slack, slack + length * slope)
        return count + 1, qacc, slack, done | exact | small

    def unfinished(state: tuple[Array, Array, Array, Array]) -> Array:
        return (state[0] < iterations) & ~jnp.all(state[3])

    start = (jnp.zeros((), jnp.int32), qacc, slack, jnp.zeros(qacc.shape[1], bool))
    _, qacc, slack, _ = jax.lax.while_loop(unfinished, newton_step, start)
    force = _barrier(-jnp.where(slack < 0, weight * slack, 0.0))
    return qacc, multiply(transposed, force)


#: Steps, length, bracket (low, high), first and second derivative, done.
_Search = tuple[Array, Array, Array, Array, Array, Array, Array]


def _line_search(
    linear: Array,
    quadratic: Array,
    *,
    slack: Array,
    slope: Array,
    weight: Array,
    steepness: Array,
    done: Array,
    most: int,
) -> Array:
    """Length (B,) along a Newton step where the cost's derivative vanishes: Newton's method within a bracket.

    The smooth part of the derivative is linear + length * quadratic, (B,) each; slack, slope and weight (E, B) are the
    rows' values, derivatives and weights; steepness (B,) is the size of the derivative at length 0; where done (B,) the
    full step, length 1, is right; at most ``most`` steps.
    """

    def derivatives(length: Array) -> tuple[Array, Array]:
        value = slack + length * slope
        pressed = jnp.where(value < 0, weight * slope, 0.0)
        return linear + length * quadratic + _total(pressed * value), quadratic + _total(pressed * slope)

    def body(state: _Search) -> _Search:
        count, length, low, high, first, second, done = state
        trial = length - first / second
        middle = jnp.where(high < jnp.inf, 0.5 * (low + high), trial)
        trial = jnp.where((trial > low) & (trial < high), trial, middle)
        length = jnp.where(done, length, trial)
        first, second = derivatives(length)
        low = jnp.where(first < 0, length, low)
        high = jnp.where(first < 0, high, length)
        return count + 1, length, low, high, first, second, done | (jnp.abs(first) < _FLAT * steepness)

    length = jnp.ones_like(linear)
    first, second = derivatives(length)
    low, high = jnp.where(first < 0, 1.0, 0.0), jnp.where(first < 0, jnp.inf, 1.0)
    start = (jnp.zeros((), jnp.int32), length, low, high, first, second, done | (jnp.abs(first) < _FLAT * steepness))
    return jax.lax.while_loop(lambda s: (s[0] < most) & ~jnp.all(s[-1]), body, start)[1]
