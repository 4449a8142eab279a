"""How far the runs of a plan are, and how long the rest will take. Nothing here imports JAX."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from experiments.plan import FACTORS, Budget, Curve, Member
from experiments.report import RESULTS, read
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.tables import read_csv
from rcg_jax.runs.folder import RunFolder

#: Time of seeds in one process on a CPU, relative to one after the other (measured on ring_peg, five seeds, two cores).
TOGETHER = 0.66

#: Start, compilation and final evaluation of a member [s].
OVERHEAD_S = 30.0


@dataclass(frozen=True)
class State:
    """How far a member is.

    Attributes:
        done: iterations of its slowest seed.
        finished: whether they, and the final evaluation, are done.
        busy: whether another process is writing there now.
        conflict: why it cannot go on, or empty.
    """

    done: int
    finished: bool
    busy: bool = False
    conflict: str = ""

    def words(self, total: int) -> str:
        """For the table."""
        if self.conflict:
            return "other settings"
        if self.finished:
            return "finished"
        text = f"{self.done} of {total}" if self.done else "not begun"
        return f"{text}, running elsewhere" if self.busy else text


def last_iteration(folder: RunFolder) -> int:
    """Rows of a seed's metrics."""
    rows = read_csv(folder.metrics_file)[1]
    return int(rows[-1][0]) if rows and rows[-1][0].isdecimal() else 0


def _evaluated(folder: RunFolder, iteration: int, episodes: int) -> bool:
    """Whether a seed has the evaluation with which a run ends."""
    header, rows = read_csv(folder.eval_file)
    if "episodes" not in header:
        return False
    number = header.index("episodes")
    return any(int(row[0]) >= iteration and int(row[number]) >= episodes for row in rows)


def _busy(folder: RunFolder) -> bool:
    """Whether a process holds the folder's lock."""
    try:
        lock = os.open(folder.path / ".lock", os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(lock)
    return False


def state(member: Member) -> State:
    """Looks at a member's folders."""
    config, folders = member.config, member.folders
    try:
        for folder in folders:
            folder.check()
    except ConfigError as error:
        return State(0, finished=False, conflict=str(error))
    done = min(last_iteration(folder) for folder in folders)
    finished = done >= config.iterations and all(
        _evaluated(folder, config.iterations, config.evaluation.final_episodes) for folder in folders
    )
    return State(done, finished, busy=not finished and any(map(_busy, folders)))


def measured(folder: RunFolder) -> float | None:
    """Seconds of an iteration of a run on this machine, evaluations included; None before the first."""
    header, rows = read_csv(folder.metrics_file)
    if not rows or "wall_s" not in header:
        return None
    return float(rows[-1][header.index("wall_s")]) / int(rows[-1][0])


@dataclass
class Estimates:
    """Seconds of an iteration of a curve's member, and where the number comes from.

    The best there is: measured here on the same curve, on the same task, else committed in ``runs.csv`` for the same
    engine, else the budget's estimate.

    Attributes:
        budget: whose runs.
        here: measured ones, by curve.
        committed: those of ``runs.csv``, by curve; of one seed a process.
        skipped: members that failed, which take no more time now.
    """

    budget: Budget
    here: dict[Curve, float] = field(default_factory=dict)
    committed: dict[Curve, float] = field(default_factory=dict)
    skipped: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, budget: Budget, members: Sequence[Member], results: Path = RESULTS) -> Estimates:
        """From what the folders of ``members`` and ``runs.csv`` hold."""
        found = cls(budget)
        for member in members:
            if not state(member).conflict:
                found.learn(member)
        table, every = results / "runs.csv", dict[Curve, list[float]]()
        for row in read(table) if table.exists() and not budget.together else []:
            alone = row.get("together", "") in ("", "1")
            if alone and row["engine"] == budget.engine and not row["settings"] and float(row["seconds"] or 0) > 0:
                curve = Curve(row["task"], row["method"], row["reward"], row["preset"])
                one = float(row["seconds"]) / int(row["iterations"])
                every.setdefault(curve, []).append(one)
        found.committed = {curve: sum(values) / len(values) for curve, values in every.items()}
        return found

    def learn(self, member: Member) -> None:
        """Takes over what a member's folder shows."""
        if seconds := measured(member.folders[0]):
            self.here[member.curve] = seconds

    def skip(self, member: Member) -> None:
        """Counts a member no more."""
        self.skipped.add(member.name)

    def seconds(self, curve: Curve, together: int = 1) -> tuple[float | None, str]:
        """Seconds of an iteration of ``together`` seeds in one process, and how they are known."""
        factor = FACTORS.get(curve.method, 1.0)
        for known, how in ((self.here, "measured here"), (self.committed, "as committed")):
            if curve in known:
                return known[curve], how
            alike = [
                value / FACTORS.get(each.method, 1.0)
                for each, value in known.items()
                if each.task == curve.task and each.preset == curve.preset
            ]
            if alike:
                return factor * sum(alike) / len(alike), f"{how}, other methods"
        seconds = self.budget.length(curve).seconds
        if self.budget.engine == "native" and together > 1:
            factor *= TOGETHER * together
        return None if seconds is None else factor * seconds, "estimated"

    def left(self, member: Member, now: State) -> float | None:
        """Seconds that a member still takes; None where nobody knows."""
        if now.finished or now.conflict or member.name in self.skipped:
            return 0.0
        seconds = self.seconds(member.curve, member.config.num_seeds)[0]
        return None if seconds is None else OVERHEAD_S + seconds * max(0, member.config.iterations - now.done)
