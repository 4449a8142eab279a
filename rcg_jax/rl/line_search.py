"""The acceptance of a TRPO step: the longest backtracked step that improves the surrogate within the KL bound."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array


@struct.dataclass
class LineSearchResult:
    """Outcome of a line search.

    Attributes:
        params: (P,) the accepted parameters, or the old ones.
        accepted: () bool.
        gain: () surrogate improvement, 0 if none was accepted.
        kl: () mean KL of the accepted step.
        attempts: () int32.
    """

    params: Array
    accepted: Array
    gain: Array
    kl: Array
    attempts: Array


def backtracking_line_search(
    evaluate: Callable[[Array], tuple[Array, Array]],
    params: Array,
    full_step: Array,
    *,
    max_kl: Array | float,
    ratio: float,
    max_backtracks: int,
) -> LineSearchResult:
    """Tries params + ratio^k full_step, k = 0, 1, ..., and stops at the first that is acceptable.

    Args:
        evaluate: parameters (P,) -> (surrogate gain over the old policy, mean KL from the old policy).
        params: (P,) old parameters.
        full_step: (P,).
        max_kl: delta; a step is accepted if its gain is > 0 and its KL is <= delta, both finite.
        ratio: backtracking factor.
        max_backtracks: attempts.
    """

    def unfinished(r: LineSearchResult) -> Array:
        return ~r.accepted & (r.attempts < max_backtracks)

    def attempt(r: LineSearchResult) -> LineSearchResult:
        candidate = params + ratio ** r.attempts.astype(params.dtype) * full_step
        gain, kl = evaluate(candidate)
        ok = (gain > 0.0) & (kl <= max_kl) & jnp.isfinite(gain)  # a NaN compares False
        return LineSearchResult(
            params=jnp.where(ok, candidate, params),
            accepted=ok,
            gain=jnp.where(ok, gain, 0.0),
            kl=jnp.where(ok, kl, 0.0),
            attempts=r.attempts + 1,
        )

    zero = jnp.zeros((), params.dtype)
    start = LineSearchResult(params=params, accepted=jnp.zeros((), bool), gain=zero, kl=zero, attempts=jnp.int32(0))
    return jax.lax.while_loop(unfinished, attempt, start)
