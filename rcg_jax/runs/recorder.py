"""Everything that one seed's run writes, with the failures of a full disk turned into warnings and retries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.io.tables import CsvLog, TensorBoardLog, Value, read_csv, write_csv
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.start_record import STARTS_COLUMNS

#: Columns that depend on the machine; the last ones of metrics.csv.
WALL_CLOCK = ("wall_s", "steps_per_s")

EVAL_COLUMNS = (
    "iteration",
    "env_steps",
    "success_stochastic",
    "success_stochastic_low",
    "success_stochastic_high",
    "success_mean",
    "success_mean_low",
    "success_mean_high",
    "episodes",
    "starts_sha256",
)

#: Columns of final_evaluation.csv: which feasible start, and how the episode of each policy from there went.
OUTCOME_COLUMNS = ("iteration", "start", "success_stochastic", "steps_stochastic", "success_mean", "steps_mean")


@dataclass(frozen=True)
class Evaluation:
    """Success on rho_0 after an iteration; intervals are 95 %."""

    iteration: int
    env_steps: int
    successes_stochastic: int
    successes_mean: int
    episodes: int
    starts_sha256: str

    @property
    def success_stochastic(self) -> float:
        """Success rate of the stochastic policy."""
        return self.successes_stochastic / self.episodes

    @property
    def success_mean(self) -> float:
        """Success rate of the policy's mean action."""
        return self.successes_mean / self.episodes

    def row(self, interval: Callable[[int, int], tuple[float, float]]) -> dict[str, Value]:
        """Its row in eval.csv."""
        stochastic = interval(self.successes_stochastic, self.episodes)
        mean = interval(self.successes_mean, self.episodes)
        cells = (
            self.iteration,
            self.env_steps,
            self.success_stochastic,
            *stochastic,
            self.success_mean,
            *mean,
            self.episodes,
            self.starts_sha256,
        )
        return dict(zip(EVAL_COLUMNS, cells, strict=True))


def read_evaluation(path: Path, iteration: int) -> Evaluation | None:
    """The evaluation after ``iteration`` with most episodes in the eval.csv ``path``; None if it has none."""
    header, rows = read_csv(path)
    if tuple(header) != EVAL_COLUMNS:
        return None
    mine = [row for cells in rows if int((row := dict(zip(header, cells, strict=True)))["iteration"]) == iteration]
    if not mine:
        return None
    row = max(mine, key=lambda row: int(row["episodes"]))
    episodes = int(row["episodes"])
    stochastic, mean = (round(float(row[f"success_{name}"]) * episodes) for name in ("stochastic", "mean"))
    return Evaluation(iteration, int(row["env_steps"]), stochastic, mean, episodes, row["starts_sha256"])


def has_evaluation(folder: RunFolder, iteration: int, episodes: int) -> bool:
    """Whether eval.csv has an evaluation after ``iteration`` with at least ``episodes`` episodes."""
    header, rows = read_csv(folder.eval_file)
    if tuple(header) != EVAL_COLUMNS:
        return False
    number = header.index("episodes")
    return any(int(row[0]) == iteration and int(row[number]) >= episodes for row in rows)


class Recorder:
    """The logs of one seed.

    Attributes:
        folder: its folder.
        wall_s: seconds of training before this process.
        env_steps: environment steps before this process.
    """

    def __init__(
        self, folder: RunFolder, columns: Sequence[str] | None, *, start: int, warn: Callable[[str], None]
    ) -> None:
        """Opens the logs, without the rows after iteration ``start``.

        Args:
            folder: the seed's folder.
            columns: of metrics.csv, without the wall-clock ones; None: those that it has.
            start: iteration to continue from.
            warn: told about what could not be written.

        Raises:
            OSError: they cannot be written.
            ColumnsError: they have other columns.
        """
        self.folder, self._warn = folder, warn
        header = read_csv(folder.metrics_file)[0] if columns is None else [*columns, *WALL_CLOCK]
        self._metrics = CsvLog(folder.metrics_file, header, keep=start)
        self._evals = CsvLog(folder.eval_file, EVAL_COLUMNS, keep=start)
        self._starts = CsvLog(folder.starts_file, STARTS_COLUMNS, keep=start)
        self._board = TensorBoardLog(folder.tensorboard, after=start)
        rows = self._metrics.kept
        if len(rows) != start:
            warn(f"{folder.metrics_file} has {len(rows)} of {start} rows; the missing ones cannot be computed again")
        self.wall_s = float(rows[-1]["wall_s"]) if rows else 0.0
        self.env_steps = int(rows[-1]["env_steps"]) if rows else 0

    def last_evaluation(self) -> tuple[int, float] | None:
        """(iteration, success on rho_0) of the last evaluation before this process."""
        if not self._evals.kept:
            return None
        row = self._evals.kept[-1]
        return int(row["iteration"]), float(row["success_stochastic"])

    @property
    def complete(self) -> bool:
        """Whether all rows are on the disk. Only then may a checkpoint go past them."""
        return not any(log.pending for log in (self._metrics, self._evals, self._starts))

    def _try(self, what: str, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self._warn(f"{what}: {error.strerror or error}; training goes on, the next iteration tries again")

    def add_metrics(self, row: Mapping[str, Value]) -> None:
        """Writes one iteration's row."""
        iteration = row["iteration"]
        assert isinstance(iteration, int)
        self._try(str(self._metrics.path), lambda: self._metrics.append(row))
        self._try(str(self.folder.tensorboard), lambda: self._board.add(iteration, row))

    def add_starts(self, row: Mapping[str, Value]) -> None:
        """Writes one iteration's starts, as of :func:`rcg_jax.runs.start_record.start_row`."""
        self._try(str(self._starts.path), lambda: self._starts.append(row))

    def write_outcomes(self, rows: Sequence[Sequence[Value]]) -> None:
        """Writes the episodes of the final evaluation, cells in the order of :data:`OUTCOME_COLUMNS`."""
        path = self.folder.outcomes_file
        try:
            write_csv(path, OUTCOME_COLUMNS, rows)
        except OSError as error:
            self._warn(f"{path}: {error.strerror or error}; the report makes these episodes again")

    def add_evaluation(self, row: Mapping[str, Value]) -> None:
        """Writes one evaluation's row."""
        iteration = row["iteration"]
        assert isinstance(iteration, int)
        self._try(str(self._evals.path), lambda: self._evals.append(row))
        values = {f"rho_0/{name}": value for name, value in row.items() if name.startswith("success")}
        self._try(str(self.folder.tensorboard), lambda: self._board.add(iteration, values))

    def flush(self) -> None:
        """Tries again to write what a full disk refused."""
        if not self.complete:
            self._try(str(self._evals.path), self._evals.flush)
            self._try(str(self._metrics.path), self._metrics.flush)
            self._try(str(self._starts.path), self._starts.flush)
