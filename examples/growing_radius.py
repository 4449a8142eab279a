"""A start-state method of one's own: feasible starts within a radius of the goal that grows with success.

python -m rcg_jax.run task=ring_peg method=examples/growing_radius.py:GrowingRadius engine=native
"""

import jax
import jax.numpy as jnp

from rcg_jax.methods.base import classify_starts
from rcg_jax.types import sample_starts


class GrowingRadius:
    def __init__(self, task, config):
        self._config = config.curriculum
        self._feasible = task.feasible_starts()
        snapshot = task.snapshot(task.reset(self._feasible))
        self._distance = jax.vmap(task.distance)(snapshot)

    def init(self, key):
        return jnp.quantile(self._distance, 0.01)

    def propose(self, key, radius, agent):
        near = self._feasible.replace(valid=self._distance <= radius)
        return radius, sample_starts(key, near, self._config.num_new + self._config.num_old)

    def update(self, key, radius, starts, labels):
        _, metrics = classify_starts(self._config, starts, labels)
        grown = jnp.minimum(1.2 * radius, jnp.max(self._distance))
        return jnp.where(metrics.share_high > 0.7, grown, radius), metrics
