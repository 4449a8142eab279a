"""A logger of one's own beside CSV and TensorBoard: ``logger=path/to/file.py:ClassName``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from rcg_jax.config.load_class import describe, load_class
from rcg_jax.config.settings import Config, ConfigError, flatten
from rcg_jax.io.tables import Value


class Logger(Protocol):
    """What the class has to be. One object per seed; made before the first iteration of every process of the run."""

    def __init__(self, config: Mapping[str, Any], folder: Path) -> None:
        """``config``: the run's settings by dotted name; ``folder``: the seed's, the same whenever the run resumes."""

    def log(self, iteration: int, values: Mapping[str, float]) -> None:
        """The numbers of an iteration, those of metrics.csv, or of an evaluation, ``rho_0/success_stochastic`` ..."""

    def close(self) -> None:
        """The end of this process."""


def logger_class(name: str) -> type | None:
    """The class that ``logger=`` names; None for ``none``.

    Raises:
        ConfigError: it cannot be imported, or lacks a method.
    """
    if name == "none":
        return None
    cls = load_class("logger", name)
    missing = [method for method in ("log", "close") if not callable(getattr(cls, method, None))]
    if missing:
        raise ConfigError(f"logger={name}: {cls.__name__} has no {', '.join(missing)} (docs/index.md)")
    return cls


class OwnLogger:
    """A user's logger that cannot stop the training: what it raises is a warning, and the last that is heard of it."""

    def __init__(self, config: Config, folder: Path, warn: Callable[[str], None]) -> None:
        """Makes the object that ``config.logger`` names; none for ``none``.

        Raises:
            ConfigError: as of :func:`logger_class`, or it cannot be made.
        """
        self._name, self._warn = config.logger, warn
        self._logger: Logger | None = None
        cls = logger_class(config.logger)
        if cls is None:
            return
        try:
            self._logger = cls({name: value for name, _, value in flatten(config)}, folder)
        except Exception as error:
            raise ConfigError(f"logger={config.logger}: {describe(error)}") from error

    def log(self, iteration: int, values: Mapping[str, Value]) -> None:
        """Passes the numbers among ``values`` on."""
        numbers = {name: float(value) for name, value in values.items() if isinstance(value, int | float)}
        self._call("log", iteration, numbers)

    def close(self) -> None:
        """Closes it."""
        self._call("close")
        self._logger = None

    def _call(self, method: str, *args: Any) -> None:
        if self._logger is None:
            return
        try:
            getattr(self._logger, method)(*args)
        except Exception as error:  # a network that is down, for instance
            self._logger = None
            self._warn(f"logger={self._name}: {method}: {describe(error)}; training goes on without it")
