"""Everything that one seed's run writes, with the failures of a full disk turned into warnings and retries."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.evaluate.stats import wilson_interval
from rcg_jax.io.tables import CsvLog, TensorBoardLog, Value, read_csv, write_csv
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.logger import OwnLogger
from rcg_jax.runs.start_record import STARTS_COLUMNS

#: Columns that depend on the machine; the last ones of metrics.csv.
WALL_CLOCK = ("wall_s", "steps_per_s")

EVAL_COLUMNS = (
    *("iteration", "env_steps", "success_stochastic", "success_stochastic_low", "success_stochastic_high"),
    *("success_mean", "success_mean_low", "success_mean_high", "episodes", "starts_sha256"),
)

#: Levels of success on rho_0 whose time is written down, and the columns of reached.csv; seconds are counted from the
#: start of the command, and hold the training of earlier processes of the run, too.
LEVELS = (0.5, 0.9)
REACHED_COLUMNS = ("iteration", "env_steps", "level", "seconds", "success_stochastic", "episodes")

#: Columns of final_evaluation.csv: which feasible start, and how the episode of each policy from there went.
OUTCOME_COLUMNS = ("iteration", "start", "success_stochastic", "steps_stochastic", "success_mean", "steps_mean")


@dataclass(frozen=True)
class Evaluation:
    """Success on rho_0 after an iteration."""

    iteration: int
    env_steps: int
    successes_stochastic: int
    successes_mean: int
    episodes: int
    starts_sha256: str

    def row(self) -> dict[str, Value]:
        """Its row in eval.csv, with 95 % intervals."""
        cells: list[Value] = [self.iteration, self.env_steps]
        for successes in (self.successes_stochastic, self.successes_mean):
            cells += [successes / self.episodes, *wilson_interval(successes, self.episodes)]
        return dict(zip(EVAL_COLUMNS, [*cells, self.episodes, self.starts_sha256], strict=True))


def read_evaluation(path: Path, iteration: int) -> Evaluation | None:
    """The evaluation after ``iteration`` with most episodes in the eval.csv ``path``; None if it has none."""
    header, rows = read_csv(path)
    if tuple(header) != EVAL_COLUMNS:
        return None
    named = [dict(zip(header, cells, strict=True)) for cells in rows if int(cells[0]) == iteration]
    if not named:
        return None
    row = max(named, key=lambda row: int(row["episodes"]))
    episodes = int(row["episodes"])
    stochastic, mean = (round(float(row[f"success_{name}"]) * episodes) for name in ("stochastic", "mean"))
    return Evaluation(iteration, int(row["env_steps"]), stochastic, mean, episodes, row["starts_sha256"])


def has_evaluation(folder: RunFolder, iteration: int, episodes: int) -> bool:
    """Whether eval.csv has an evaluation after ``iteration`` with at least ``episodes`` episodes."""
    found = read_evaluation(folder.eval_file, iteration)
    return found is not None and found.episodes >= episodes


class Recorder:
    """The logs of one seed.

    Attributes:
        wall_s: seconds of training before this process.
        env_steps: environment steps so far.
        evaluated: (iteration, success on rho_0) of the last evaluation before this process.
    """

    def __init__(
        self, folder: RunFolder, columns: Sequence[str] | None, *, start: int, warn: Callable[[str], None]
    ) -> None:
        """Opens the logs, without the rows after iteration ``start``.

        Args:
            folder: the seed's.
            columns: of metrics.csv, without the wall-clock ones; None: those that it has.
            start: iteration to continue from.
            warn: told about what could not be written.

        Raises:
            OSError: they cannot be written.
            ColumnsError: they have other columns.
            ConfigError: the logger of one's own cannot be used.
        """
        self.folder, self._warn = folder, warn
        header = read_csv(folder.metrics_file)[0] if columns is None else [*columns, *WALL_CLOCK]
        self._metrics = CsvLog(folder.metrics_file, header, keep=start)
        self._evals = CsvLog(folder.eval_file, EVAL_COLUMNS, keep=start)
        self._reached = CsvLog(folder.reached_file, REACHED_COLUMNS, keep=start)
        self._starts = CsvLog(folder.starts_file, STARTS_COLUMNS, keep=start)
        self._board = TensorBoardLog(folder.tensorboard, after=start)
        self._own = OwnLogger(folder.config, folder.path, warn)
        rows, evals = self._metrics.kept, self._evals.kept
        known = {float(row["level"]) for row in self._reached.kept}
        best = max((float(row["success_stochastic"]) for row in evals), default=0.0)  # of before there was such a file
        self._levels = {level for level in LEVELS if level not in known and level > best}
        if len(rows) != start:
            warn(f"{folder.metrics_file} has {len(rows)} of {start} rows; the missing ones cannot be computed again")
        self.wall_s = float(rows[-1]["wall_s"]) if rows else 0.0
        self.env_steps = int(rows[-1]["env_steps"]) if rows else 0
        self.evaluated = (int(evals[-1]["iteration"]), float(evals[-1]["success_stochastic"])) if evals else None

    @property
    def complete(self) -> bool:
        """Whether all rows are on the disk. Only then may a checkpoint go past them."""
        return not any(log.pending for log in self._logs)

    @property
    def _logs(self) -> tuple[CsvLog, ...]:
        return self._evals, self._metrics, self._starts, self._reached

    def add_metrics(self, row: Mapping[str, Value]) -> None:
        """Writes one iteration's row."""
        self._append(self._metrics, row)
        self._plot(row, row)

    def add_starts(self, row: Mapping[str, Value]) -> None:
        """Writes one iteration's starts, as of :func:`rcg_jax.runs.start_record.start_row`."""
        self._append(self._starts, row)

    def add_evaluation(self, evaluation: Evaluation, seconds: float = 0.0) -> list[str]:
        """Writes one evaluation's row; returns what it reached for the first time, in words.

        Args:
            evaluation: success on rho_0.
            seconds: since this process's command was started.
        """
        row = evaluation.row()
        success, told = evaluation.successes_stochastic / evaluation.episodes, []
        for level in sorted(level for level in self._levels if level <= success):
            self._levels.remove(level)
            total, steps = self.wall_s + seconds, evaluation.env_steps
            cells = (evaluation.iteration, steps, level, total, success, evaluation.episodes)
            self._append(self._reached, dict(zip(REACHED_COLUMNS, cells, strict=True)))
            told.append(f"{level} on rho_0 after {total:.0f} s, {steps / 1e6:.2f}M steps")
        self._append(self._evals, row)  # last: a run that is killed before it makes this evaluation again
        self._plot(row, {f"rho_0/{name}": value for name, value in row.items() if name.startswith("success")})
        return told

    def write_outcomes(self, rows: Sequence[Sequence[Value]]) -> None:
        """Writes the episodes of the final evaluation, cells in the order of :data:`OUTCOME_COLUMNS`."""
        path = self.folder.outcomes_file
        with self._warning(path, "the report makes these episodes again"):
            write_csv(path, OUTCOME_COLUMNS, rows)

    def flush(self) -> None:
        """Tries again to write what a full disk refused."""
        for log in self._logs:
            if log.pending:
                with self._warning(log.path):
                    log.flush()

    def close(self) -> None:
        """Nothing more is going to be written."""
        self._board.close()
        self._own.close()

    def _append(self, log: CsvLog, row: Mapping[str, Value]) -> None:
        with self._warning(log.path):
            log.append(row)

    def _plot(self, row: Mapping[str, Value], values: Mapping[str, Value]) -> None:
        iteration = row["iteration"]
        assert isinstance(iteration, int)
        with self._warning(self.folder.tensorboard):
            self._board.add(iteration, values)
        self._own.log(iteration, values)

    @contextmanager
    def _warning(self, path: Path, then: str = "training goes on, the next iteration tries again") -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._warn(f"{path}: {error.strerror or error}; {then}")
