"""What a vector environment tells a curriculum."""

from __future__ import annotations

import numpy as np

from rcg_jax.methods.reverse_curriculum import ReverseCurriculum, Starts


class EndedEpisodes:
    """Episodes that have ended, until those of a whole iteration can be reported to the curriculum.

    As many of every environment count: quick successes are not counted more often than slow failures.
    """

    def __init__(self, curriculum: ReverseCurriculum, num_envs: int) -> None:
        self.curriculum = curriculum
        self._each = -(-curriculum.episodes // num_envs)
        self.begin(np.zeros(num_envs, bool))

    def begin(self, old: np.ndarray) -> None:
        """``old`` (B,): environments whose running episode began in other starts than the present ones."""
        self.old, self._left = old, np.full(len(old), self._each)
        self._rows: list[np.ndarray] = []
        self._successes: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def add(self, done: np.ndarray, start: np.ndarray, success: np.ndarray, steps: np.ndarray) -> bool:
        """Takes what ended in one step; whether the curriculum has new starts."""
        counted = done & ~self.old & (self._left > 0) & (start >= 0)
        self.old = self.old & ~done
        self._left -= counted
        for kept, value in ((self._rows, start), (self._successes, success), (self._steps, steps)):
            kept.append(value[counted])
        if self._left.any():
            return False
        rows = np.concatenate(self._rows)
        about = self.curriculum
        starts = Starts(np.asarray(about.starts.qpos)[rows], np.asarray(about.starts.qvel)[rows], rows, about.iteration)
        about.report(starts, np.concatenate(self._successes), np.concatenate(self._steps))
        return True
