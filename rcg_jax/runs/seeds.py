"""Several seeds side by side in one program, and each on its own in what is written down."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rcg_jax.io.tables import Value
from rcg_jax.sharding.keys import key_data, wrap_keys

#: Keeps the keys of evaluation apart from those of training.
_EVALUATION_STREAM = 0x5EED


def evaluation_key(seed: int, iteration: int) -> Array:
    """PRNG key of the evaluation after ``iteration``; it depends on nothing else, and training does not see it."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(_EVALUATION_STREAM), seed), iteration)


def metric_rows(metrics: Any, num_seeds: int) -> list[dict[str, Value]]:
    """Metrics of an iteration, a (nested) dataclass of scalars, or of (S,) if there are several, as a row per seed."""
    leaves = jax.tree_util.tree_flatten_with_path(metrics)[0]
    columns = {path[-1].name: np.reshape(leaf, num_seeds).tolist() for path, leaf in leaves}
    assert len(columns) == len(leaves), "two metrics have the same name"
    return [{name: values[k] for name, values in columns.items()} for k in range(num_seeds)]


def outcome_rows(result: Any, num_seeds: int) -> list[list[tuple[int, ...]]]:
    """The episodes of an :class:`rcg_jax.evaluate.success.EvalResult`, of S seeds if there are several.

    Returns:
        For each seed E rows: start, success and steps of the stochastic policy, and of the mean one.
    """
    episodes = [leaf for policy in (result.stochastic, result.mean) for leaf in (policy.success, policy.length)]
    columns = np.stack([np.reshape(leaf, (num_seeds, -1)) for leaf in (result.start, *episodes)], axis=-1)
    return [[tuple(row) for row in seed] for seed in columns.astype(int).tolist()]


def stack(states: list[Any]) -> Any:
    """Train states side by side, with a leading axis of seeds; a single one stays as it is."""
    return states[0] if len(states) == 1 else jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def unstack(state: Any, num_seeds: int) -> list[Any]:
    """The inverse of :func:`stack`."""
    if num_seeds == 1:
        return [state]
    return [jax.tree.map(lambda leaf, k=k: leaf[k], state) for k in range(num_seeds)]


def strong(state: Any) -> Any:
    """Without weak types, which a checkpoint would lose: the same program is compiled at the start and after it."""
    return wrap_keys(jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), key_data(state)), state)
