"""Sweeps: ``-m`` with several values of a field, one run per combination, through Hydra's launchers."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcg_jax.config import compose as cli
from rcg_jax.config.class_path import class_name
from rcg_jax.config.settings import Config, ConfigError

_OUTCOME = "outcome.json"

#: In a sweep's folder: members that have not begun shall not.
_STOP = "stop"

#: In a sweep's folder: members that run side by side shall save and end; they look for it every so many seconds.
_END, _LOOK_S = "end", 0.5

#: Hydra's launchers that come in packages of their own (``pip install "rcg_jax[launchers]"``).
_LAUNCHERS = {
    "joblib": "hydra_joblib_launcher",
    "submitit_local": "hydra_submitit_launcher",
    "submitit_slurm": "hydra_submitit_launcher",
}

#: Fields that the folder of a run shows already.
_IN_PATH = ("task", "method", "seed", "run_dir")


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The settings of every member of a sweep, in Hydra's order."""
    batches = BasicSweeper.split_arguments(cli.parse_overrides(overrides), None)
    return [list(member) for batch in batches for member in batch]


def _base(overrides: Sequence[str]) -> str:
    """The run_dir that the user gave; the first one of a sweep over it."""
    given = [each for each in cli.parse_overrides(overrides) if each.key_or_group == "run_dir"]
    if not given:
        return Config().run_dir
    return next(given[-1].sweep_string_iterator()) if given[-1].is_sweep_override() else str(given[-1].value())


def with_own_folders(overrides: Sequence[str]) -> list[str]:
    """Adds what sends members that differ in more than task, method and seed to folders of their own.

    ``-m trpo.max_kl=0.01,0.02`` runs in ``<run_dir>/trpo.max_kl-0.01/`` and ``<run_dir>/trpo.max_kl-0.02/``.
    """
    parsed = cli.parse_overrides(overrides)
    swept = [each.key_or_group for each in parsed if each.is_sweep_override()]
    own = [name for name in dict.fromkeys(swept) if name not in _IN_PATH and not name.startswith("hydra")]
    if not own or "run_dir" in swept:
        return list(overrides)
    folder = "/".join([_base(overrides), *(f"{name}-${{{name}}}" for name in own)]).replace("'", "\\'")
    return [*overrides, f"run_dir='{folder}'"]


def _installed(plugin: str) -> bool:
    try:
        return importlib.util.find_spec(f"hydra_plugins.{plugin}") is not None
    except ModuleNotFoundError:  # no plugin at all
        return False


def check_launcher(overrides: Sequence[str]) -> str:
    """The name of the launcher asked for, empty if none is; refuses one that is not there.

    Raises:
        ConfigError: says what to do.
    """
    chosen = [each.value() for each in cli.parse_overrides(overrides) if each.key_or_group == "hydra/launcher"]
    if not chosen:
        return ""
    name = str(chosen[-1])
    package = _LAUNCHERS.get(name)
    if package and not _installed(package):
        raise ConfigError(f'hydra/launcher={name}: is not installed; pip install "rcg_jax[launchers]"')
    if not package and name not in cli.launchers():
        raise ConfigError(f"hydra/launcher={name}: must be one of {', '.join(sorted({*cli.launchers(), *_LAUNCHERS}))}")
    if name == "submitit_slurm" and shutil.which("sbatch") is None:
        raise ConfigError(f"hydra/launcher={name}: no sbatch here; submit from a node of the cluster")
    return name


def check(overrides: Sequence[str]) -> list[tuple[list[str], Config]]:
    """Settings and configuration of every member.

    Raises:
        ConfigError: one of them cannot run, or two of them would write to the same folder.
    """
    members = []
    for settings in expand(overrides):
        try:
            own = [text for text in settings if not text.startswith("hydra")]
            config = cli.compose_config(own)
            if config.hosts.coordinator != "none":
                raise ConfigError(
                    f"hosts.coordinator={config.hosts.coordinator}: "
                    "a sweep's members have one process each; must be none"
                )
            members.append((settings, config))
        except ConfigError as error:
            raise ConfigError(f"{error} (sweep member {len(members)}: {' '.join(settings)})") from None
    folders = Counter(
        f"{config.run_dir}/{class_name(config.task)}/{class_name(config.method)}/seed{seed}"
        for _, config in members
        for seed in range(config.seed, config.seed + config.num_seeds)
    )
    for folder, count in folders.items():
        if count > 1:
            raise ConfigError(f"{count} members of this sweep would write to {folder}")
    return members


class MemberOutput(io.TextIOBase):
    """An output that members of a sweep share while they run side by side: whole lines, marked with their member."""

    def __init__(self, out: TextIO, member: int | str) -> None:
        """Args: where the lines go, and the member's number."""
        self._out, self._mark, self._rest = out, f"[{member}] ", ""

    def isatty(self) -> bool:
        """Never: live bars would overwrite each other."""
        return False

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        if lines:
            self._out.write("".join(f"{self._mark}{line}\n" for line in lines))
            self._out.flush()
        return len(text)

    def flush(self) -> None:
        self._out.flush()


@contextlib.contextmanager
def _ends_with(file: Path) -> Iterator[None]:
    """Context in which this process is sent SIGTERM when ``file`` appears, once it knows how to end in order."""
    over = threading.Event()

    def look() -> None:
        while not over.wait(_LOOK_S):
            if file.exists() and callable(signal.getsignal(signal.SIGTERM)):
                os.kill(os.getpid(), signal.SIGTERM)
                return

    threading.Thread(target=look, daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _member(composed: DictConfig) -> None:
    """One run of a sweep; a failure is written down and leaves the others alone."""
    from rcg_jax.cli.execute import execute

    here = HydraConfig.get()
    settings = list(here.overrides.task)
    command = shlex.join(["python", "-m", "rcg_jax.run", *settings])
    folder = Path(here.runtime.output_dir)
    alone = str(here.launcher._target_).endswith("BasicLauncher")
    output = sys.stdout if alone else MemberOutput(sys.stdout, here.job.num)
    if not alone and (Path(here.sweep.dir) / _STOP).exists():
        return
    try:
        with contextlib.redirect_stdout(output), contextlib.ExitStack() as side_by_side:
            if not alone:
                side_by_side.enter_context(_ends_with(Path(here.sweep.dir) / _END))
            print(f"\nsweep member {here.job.num}: {' '.join(settings)}", flush=True)
            code, message = execute(cli.from_hydra(composed), command, cli.given_names(settings))
    except Exception as error:  # the other members must run
        traceback.print_exc()
        code, message = 1, f"{type(error).__name__}: {' '.join(str(error).split())}"
    except KeyboardInterrupt as stop:
        if alone:
            raise
        # A launcher that heard of it would kill the members beside, which are saving.
        code, message = getattr(stop, "exit_code", 130), str(stop) or "stopped"
        if here.launcher.get("n_jobs") == 1:  # one after the other in the sweep's own process, which did not hear of it
            (Path(here.sweep.dir) / _STOP).touch()
    outcome = {"settings": settings, "code": code, "message": message}
    (folder / _OUTCOME).write_text(json.dumps(outcome))


def through_hydra(argv: Sequence[str]) -> None:
    """Runs Hydra's own entry point with ``argv``."""
    cli.register()
    before, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [before[0], *argv]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # a launcher's exception comes through, instead of the end of the process
    try:
        hydra.main(version_base="1.3", config_path=None, config_name=cli.CONFIG_NAME)(_member)()
    finally:
        sys.argv = before
        os.environ.pop("HYDRA_FULL_ERROR")
        if full is not None:
            os.environ["HYDRA_FULL_ERROR"] = full


@contextlib.contextmanager
def _gently(folder: Path) -> Iterator[None]:
    """Context in which a first Ctrl-C or SIGTERM lets members that run side by side save and end.

    They hear Ctrl-C themselves, as processes of the same terminal, and SIGTERM through a file; those that have not
    begun are left out. A second Ctrl-C is raised, a second SIGTERM ends this process.
    """

    def handle(signum: int, frame: FrameType | None) -> None:
        signal.signal(signum, signal.default_int_handler if signum == signal.SIGINT else signal.SIG_DFL)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _STOP).touch()
        if signum == signal.SIGTERM:
            (folder / _END).touch()

    before = {signum: signal.signal(signum, handle) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


def _outcomes(folder: Path) -> list[dict[str, Any]]:
    """What became of the members that have ended."""
    return [json.loads(path.read_text()) for path in folder.rglob(_OUTCOME)]


def _one_by_one(members: Sequence[list[str]], folder: Path, command: Sequence[str], again: str = "") -> None:
    """Runs the members that have not ended, each in a process of its own, so that a kill hits one only.

    Args:
        members: their settings.
        folder: the sweep's; their outcomes are kept there.
        command: what runs one, before its settings.
        again: said of each, where it has been tried before.
    """
    ended = {tuple(outcome["settings"]) for outcome in _outcomes(folder)}
    for number, settings in enumerate(members):
        own = [text for text in settings if not text.startswith("hydra")]
        if tuple(own) in ended or (folder / _STOP).exists():
            continue
        print(f"\nsweep member {number}{again}: {' '.join(own)}", flush=True)
        process = subprocess.Popen([*command, *own])
        with _passed_on(process):
            code = process.wait()
        message = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}, see above"
        outcome = {"settings": own, "code": 128 - code if code < 0 else code, "message": message}
        place = folder / f"member-{number}"
        place.mkdir(parents=True, exist_ok=True)
        (place / _OUTCOME).write_text(json.dumps(outcome))
        if code in (128 + signal.SIGINT, 128 + signal.SIGTERM):  # it was told to stop, and so is the sweep
            return


@contextlib.contextmanager
def _passed_on(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Context in which a member hears of signals: of Ctrl-C by itself, on a terminal; of SIGTERM from here."""

    def handle(signum: int, frame: FrameType | None) -> None:
        if signum == signal.SIGTERM:
            process.send_signal(signum)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signum: signal.signal(signum, handle) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


def _command(argv: Sequence[str] | None) -> list[str]:
    """What started this process, without its settings; in a program that called ``run.main``, the module."""
    words = len(sys.argv) - 1
    if argv is not None or not sys.orig_argv or sys.orig_argv[len(sys.orig_argv) - words :] != sys.argv[1:]:
        return [sys.executable, "-m", "rcg_jax.run"]
    return [sys.executable, *sys.orig_argv[1 : len(sys.orig_argv) - words]]


def run_sweep(request: cli.Request, argv: Sequence[str] | None = None) -> int:
    """Validates all members, runs them, and says which failed.

    Without a launcher they run one after the other, each in a process of its own.

    Args:
        request: what the command line asks for.
        argv: the words of a program that calls ``run.main``; None: those of this process.

    Returns:
        Exit code: 1 if any failed, 128 + signal if members that ran side by side were stopped.

    Raises:
        ConfigError: the settings of a member cannot be used; then none was started. What a task's class asks for
            beside them is looked at when its member begins.
        Interrupted: asked to stop.
    """
    launcher = check_launcher(request.overrides)
    overrides = with_own_folders(request.overrides)
    members = check(overrides)
    given = [each.value() for each in cli.parse_overrides(overrides) if each.key_or_group == "hydra.sweep.dir"]
    if given:
        folder = Path(str(given[-1]))
    else:
        stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
        folder = Path(_base(request.overrides)) / "sweeps" / f"{stamp}.{os.getpid()}"
        quoted = str(folder).replace("'", "\\'")
        overrides = [*overrides, f"hydra.sweep.dir='{quoted}'"]
    for left in (folder / _STOP, folder / _END, *folder.rglob(_OUTCOME)):  # of an earlier sweep into this folder
        left.unlink(missing_ok=True)
    settings = [settings for settings, _ in members]
    if launcher in ("", "basic") and not any(word.startswith("hydra/") for word in overrides):
        _one_by_one(settings, folder, _command(argv))
        return _summary(settings, folder)
    with _gently(folder) if launcher == "joblib" else contextlib.nullcontext():
        try:
            through_hydra(["--multirun", *request.hydra, *overrides])
        except (Exception, SystemExit) as error:  # the launcher's: a member's process was killed, say
            print(f"\nsweep: {launcher or 'the launcher'} gave up: {' '.join(repr(error).split())[:300]}")
            if launcher == "joblib":  # which ends the healthy members, too, when one is killed
                _one_by_one(settings, folder, _command(argv), " again, alone")
    return _summary(settings, folder)


def _summary(members: Sequence[list[str]], folder: Path) -> int:
    """Says what became of the members; returns the exit code."""
    outcomes = _outcomes(folder)
    finished = sum(outcome["code"] == 0 for outcome in outcomes)
    print(f"\nsweep: {finished} of {len(members)} runs finished")
    for outcome in outcomes:
        if outcome["code"]:
            command = shlex.join(["python", "-m", "rcg_jax.run", *outcome["settings"]])
            word = "failed: " if outcome["code"] < 128 else ""
            print(f"{word}{outcome['message']}\n  resume with: {command}")
    if len(outcomes) < len(members):
        print(f"{len(members) - len(outcomes)} did not end; the same command resumes them")
    if finished == len(members):
        return 0
    return max([1, *(outcome["code"] for outcome in outcomes if outcome["code"] > 128)])
