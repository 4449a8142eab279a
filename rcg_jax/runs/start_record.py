"""What a run keeps of the starts of every iteration, rho_i: where they were, and what training showed about them.

``starts.csv`` has one row per iteration. Its cells are base64 of little-endian arrays: float16 positions, uint16
numbers of episodes. A start of seven joints takes 24 characters, 300 of them 7 KB per iteration.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rcg_jax.io.tables import Value, read_csv
from rcg_jax.types import StartLabels, StartSet

STARTS_COLUMNS = ("iteration", "starts", "qpos", "successes", "episodes")

#: Starts of one iteration that are kept, at most: more of them are thinned evenly.
MOST_STARTS = 300

_POSITION, _COUNT = np.dtype("<f2"), np.dtype("<u2")


@dataclass(frozen=True)
class StartRecord:
    """The n valid starts of one iteration.

    Attributes:
        iteration: which one, from 1.
        qpos: (n, nq) float32 positions, rounded to float16 [rad, m].
        successes, episodes: (n,) counted episodes that reached the goal, and all.
    """

    iteration: int
    qpos: np.ndarray
    successes: np.ndarray
    episodes: np.ndarray


def _encode(values: np.ndarray, dtype: np.dtype) -> str:
    if dtype == _COUNT:
        values = np.minimum(values, np.iinfo(dtype).max)
    with np.errstate(over="ignore"):  # a position beyond 65,504 becomes infinite, and is not drawn
        return base64.b64encode(np.asarray(values).astype(dtype).tobytes()).decode()


def start_row(iteration: int, starts: StartSet, labels: StartLabels) -> dict[str, Value]:
    """The row of one iteration: its starts, fetched from the device, and what training showed about them."""
    rows = np.flatnonzero(starts.valid)
    if len(rows) > MOST_STARTS:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_STARTS).astype(int)]
    arrays = ((starts.qpos, _POSITION), (labels.successes, _COUNT), (labels.episodes, _COUNT))
    encoded = [_encode(np.asarray(values)[rows], dtype) for values, dtype in arrays]
    return dict(zip(STARTS_COLUMNS, [iteration, len(rows), *encoded], strict=True))


def _decode(row: Mapping[str, str]) -> StartRecord:
    number = int(row["starts"])
    qpos, successes, episodes = (
        np.frombuffer(base64.b64decode(row[name]), dtype)
        for name, dtype in (("qpos", _POSITION), ("successes", _COUNT), ("episodes", _COUNT))
    )
    if len(successes) != number or len(episodes) != number or (number and len(qpos) % number):
        raise ValueError("arrays of different lengths")
    return StartRecord(
        iteration=int(row["iteration"]),
        qpos=qpos.reshape(number, -1).astype(np.float32) if number else np.zeros((0, 0), np.float32),
        successes=successes.astype(int),
        episodes=episodes.astype(int),
    )


def read_starts(path: Path) -> Iterator[StartRecord]:
    """The records of a ``starts.csv``, in order; rows that cannot be read are left out. None where there is no file."""
    header, rows = read_csv(path)
    if tuple(header) != STARTS_COLUMNS:
        return
    for cells in rows:
        try:
            yield _decode(dict(zip(header, cells, strict=True)))
        except ValueError:  # base64's own error is one, too
            continue
