"""The folder of one seed, ``<run_dir>/<task>/<method>/seed<k>/``, and whether a run may continue in it."""

from __future__ import annotations

import dataclasses
import fcntl
import os
from collections.abc import Collection
from pathlib import Path

from omegaconf import OmegaConf

from rcg_jax.config.class_path import class_name
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.tables import read_csv, write_atomically
from rcg_jax.runs.settings import differences, old_words, read_values


class FolderInUseError(RuntimeError):
    """Another process writes to the same folder."""


class RunFolder:
    """One seed's folder ``path``, the files in it, and that seed's settings ``config``, as if it ran alone."""

    def __init__(self, config: Config, seed: int) -> None:
        """The folder that ``config`` puts seed ``seed`` in; nothing is made yet."""
        self.path = Path(config.run_dir) / class_name(config.task) / class_name(config.method) / f"seed{seed}"
        self.config = dataclasses.replace(config, seed=seed, num_seeds=1)
        self.config_file = self.path / "config.yaml"
        self.metrics_file = self.path / "metrics.csv"  # a row per iteration
        self.eval_file = self.path / "eval.csv"  # a row per evaluation on rho_0
        self.reached_file = self.path / "reached.csv"  # when success on rho_0 first reached 0.5 and 0.9
        self.starts_file = self.path / "starts.csv"  # the starts of each iteration
        self.outcomes_file = self.path / "final_evaluation.csv"  # the episodes of the final evaluation
        self.tensorboard = self.path / "tensorboard"
        self.checkpoints = self.path / "checkpoints"
        self._lock: int | None = None

    def has_progress(self) -> bool:
        """Whether an iteration was ever finished here."""
        return any(self.checkpoints.glob("[0-9]*")) or bool(read_csv(self.metrics_file)[1])

    def check(self, asked: Collection[str] = (), left_open: Collection[str] = ()) -> None:
        """Refuses to continue a run with settings other than it was made with.

        Args:
            asked: settings that the task asks for.
            left_open: settings that were derived, and may come out differently on other devices.

        Raises:
            ConfigError: names the fields that differ, old -> new, and what to do.
        """
        if not self.has_progress():
            return
        if not self.config_file.exists():
            raise ConfigError(f"{self.path} holds a run, but no config.yaml; put it back or use another run_dir=...")
        values = read_values(self.config_file)
        spread = self.config.devices == "all" or self.config.hosts.coordinator != "none"
        derived = left_open if spread or values.get("devices") != self.config.devices else ()
        changes = differences(values, self.config, derived)
        if changes:
            names = [change.split()[0] for change in changes]
            its_own = ", ".join(name for name in names if name in asked)
            why = f" ({its_own}: as the task now sets)" if its_own else ""
            raise ConfigError(
                f"{self.path} holds a run with other settings: {', '.join(changes)}{why}; "
                f"use another run_dir=..., or the old settings to continue it{old_words(values, names)}"
            )

    def open(self) -> None:
        """Makes the folder and claims it for this process.

        Raises:
            ConfigError: a file is in its place.
            FolderInUseError: another process has it.
            OSError: it cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise ConfigError(f"run_dir={self.config.run_dir}: must be a folder, and a file is there") from None
        # The kernel releases the lock when the process ends, however it ends.
        self._lock = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.close()
            raise FolderInUseError(f"{self.path} is being written by another process") from None

    def write_config(self) -> None:
        """Writes the seed's settings, as resolved."""
        text = OmegaConf.to_yaml(OmegaConf.structured(self.config)).encode()
        if not self.config_file.exists() or self.config_file.read_bytes() != text:
            write_atomically(self.config_file, text)

    def close(self) -> None:
        """Releases the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
