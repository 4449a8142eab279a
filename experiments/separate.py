"""Which coordinates of the starts, and which ranges of them, hold the failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy import stats
from scipy.cluster.vq import kmeans2

#: Quantile bins of a coordinate, and how improbable their differences must be by chance, over all coordinates.
BINS, SIGNIFICANT = 8, 1e-3

_FREE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Separation:
    """Failures over the quantile bins of one coordinate.

    Attributes:
        coordinate: column of qpos.
        edges: (K + 1,) of the bins.
        starts, failures: (K,) episodes that began in each bin, and how many of them failed.
        first, last: the bins, both included, that hold the most failures beyond their share of the starts.
        p_value: probability that bins differ so much by chance (G-test).
        among: (N,) bool, the episodes that were counted.
    """

    coordinate: int
    edges: np.ndarray
    starts: np.ndarray
    failures: np.ndarray
    first: int
    last: int
    p_value: float
    among: np.ndarray

    def inside(self, qpos: np.ndarray) -> np.ndarray:
        """Which starts (N, nq) lie in the range with the failures, (N,) bool."""
        value = qpos[:, self.coordinate]
        low = value >= self.edges[self.first] if self.first else np.ones(len(qpos), bool)
        high = value < self.edges[self.last + 1] if self.last + 1 < len(self.starts) else np.ones(len(qpos), bool)
        return low & high & self.among

    def words(self, name: str) -> str:
        """The range: ``shoulder_pan > 1.17``."""
        low = f"{self.edges[self.first]:.2f}" if self.first else ""
        high = f"{self.edges[self.last + 1]:.2f}" if self.last + 1 < len(self.starts) else ""
        if low and high:
            return f"{name} {low} to {high}"
        return f"{name} > {low}" if low else f"{name} < {high}"


def coordinate_names(model: mujoco.MjModel) -> list[str]:
    """What the coordinates of qpos are called: a joint's name, of free and ball joints with the component."""
    names = []
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"joint {j}", model.jnt_type[j]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            names += [f"{name} {part}" for part in _FREE]
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            names += [f"{name} {part}" for part in _FREE[3:]]
        else:
            names.append(name)
    return names


def _separation(qpos: np.ndarray, failed: np.ndarray, among: np.ndarray, coordinate: int) -> Separation | None:
    """One coordinate; None where it has a single bin."""
    value = qpos[among, coordinate]
    edges = np.unique(np.quantile(value, np.linspace(0, 1, BINS + 1)))
    if len(edges) < 3:
        return None
    place = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    starts = np.bincount(place, minlength=len(edges) - 1)
    failures = np.bincount(place, failed[among], minlength=len(edges) - 1).astype(int)
    p = stats.chi2_contingency([failures, starts - failures], lambda_="log-likelihood").pvalue
    # The run of bins whose failures most exceed what their share of the starts would give.
    excess = np.cumsum([0, *(failures / failures.sum() - starts / starts.sum())])
    pairs = [(excess[b] - excess[a], a, b - 1) for b in range(len(excess)) for a in range(b)]
    _, first, last = max(pairs)
    return Separation(coordinate, edges, starts, failures, first, last, float(p), among)


def separate(qpos: np.ndarray, failed: np.ndarray, *, most: int = 2) -> list[Separation]:
    """The coordinates that tell failures best, each after the range of the one before is left out; maybe none.

    Args:
        qpos: (N, nq) starts.
        failed: (N,) bool.
        most: coordinates, at most.
    """
    found: list[Separation] = []
    among = np.ones(len(qpos), bool)
    for _ in range(most):
        if not failed[among].any() or failed[among].all():
            break
        left = set(range(qpos.shape[1])) - {one.coordinate for one in found}
        every = [_separation(qpos, failed, among, k) for k in sorted(left)]
        best = min((one for one in every if one), key=lambda one: one.p_value, default=None)
        if best is None or best.p_value * qpos.shape[1] > SIGNIFICANT:
            break
        found.append(best)
        among = among & ~best.inside(qpos)
    return found


def typical(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the middle of clusters of (N, d) points, the largest cluster first.

    Returns:
        Rows of the points nearest to the centres, (C,) with C <= ``count``; the share of all points in each cluster.
    """
    count = min(count, len(points))
    spread = points.std(axis=0)
    scaled = points / np.where(spread > 0, spread, 1.0)
    centres, label = kmeans2(scaled, count, minit="++", seed=0) if count > 1 else (scaled.mean(0)[None], None)
    label = np.zeros(len(points), int) if label is None else label
    sizes = np.bincount(label, minlength=len(centres))
    chosen = []
    for k in np.argsort(-sizes, kind="stable"):
        mine = np.flatnonzero(label == k)
        if len(mine):
            chosen.append((int(mine[np.argmin(np.sum((scaled[mine] - centres[k]) ** 2, axis=1))]), len(mine)))
    rows, counts = zip(*chosen, strict=True)
    return np.array(rows), np.array(counts) / len(points)


def as_words(names: Sequence[str], found: Sequence[Separation], qpos: np.ndarray, failed: np.ndarray) -> list[str]:
    """What the ranges hold, a sentence each."""
    lines = []
    for k, one in enumerate(found):
        inside = one.inside(qpos)
        others = "of the other starts, " if k else ""
        lines.append(
            f"{others}{one.words(names[one.coordinate])}: {100 * np.mean(inside):.0f} % of all starts and "
            f"{100 * np.sum(failed & inside) / failed.sum():.0f} % of all failures"
        )
    return lines
