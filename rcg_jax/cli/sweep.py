"""Sweeps: ``-m`` with several values of a field, one run per combination, in processes or through Hydra's launchers."""

from __future__ import annotations

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
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcg_jax.config import compose as cli
from rcg_jax.config.class_path import class_name
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.console import one_line
from rcg_jax.runs.interrupt import handling

_OUTCOME = "outcome.json"

#: Hydra's launchers that come in a package of their own (``pip install "rcg_jax[launchers]"``).
_SUBMITIT = ("submitit_local", "submitit_slurm")

#: Launchers whose members are processes of this sweep: one after the other, or side by side.
_OURS = ("basic", "joblib")

#: Fields that the folder of a run shows already.
_IN_PATH = ("task", "method", "seed", "run_dir")


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The settings of every member of a sweep, in Hydra's order."""
    batches = BasicSweeper.split_arguments(cli.parse_overrides(overrides), None)
    return [list(member) for batch in batches for member in batch]


def _last(overrides: Sequence[str], name: str, default: str) -> str:
    """What the settings say last about ``name``, or the first value of a sweep over it."""
    given = [each for each in cli.parse_overrides(overrides) if each.key_or_group == name]
    if not given:
        return default
    return next(given[-1].sweep_string_iterator()) if given[-1].is_sweep_override() else str(given[-1].value())


def _quoted(path: object) -> str:
    escaped = str(path).replace("'", "\\'")
    return f"'{escaped}'"


def with_own_folders(overrides: Sequence[str]) -> list[str]:
    """Adds what sends members that differ in more than task, method and seed to folders of their own.

    ``-m trpo.max_kl=0.01,0.02`` runs in ``<run_dir>/trpo.max_kl-0.01/`` and ``<run_dir>/trpo.max_kl-0.02/``.
    """
    swept = [each.key_or_group for each in cli.parse_overrides(overrides) if each.is_sweep_override()]
    own = [name for name in dict.fromkeys(swept) if name not in _IN_PATH and not name.startswith("hydra")]
    if not own or "run_dir" in swept:
        return list(overrides)
    base = _last(overrides, "run_dir", Config().run_dir)
    return [*overrides, f"run_dir={_quoted('/'.join([base, *(f'{name}-${{{name}}}' for name in own)]))}"]


def check_launcher(overrides: Sequence[str]) -> str:
    """The name of the launcher asked for; refuses one that is not there.

    Raises:
        ConfigError: says what to do.
    """
    name = _last(overrides, "hydra/launcher", "basic")
    if name in _SUBMITIT and not (find_spec("hydra_plugins") and find_spec("hydra_plugins.hydra_submitit_launcher")):
        raise ConfigError(f'hydra/launcher={name}: is not installed; pip install "rcg_jax[launchers]"')
    known = (*_OURS, *_SUBMITIT)
    if name not in known:
        raise ConfigError(f"hydra/launcher={name}: must be one of {', '.join(known)}")
    if name == "submitit_slurm" and shutil.which("sbatch") is None:
        raise ConfigError(f"hydra/launcher={name}: no sbatch here; submit from a node of the cluster")
    return name


def _number_of_jobs(overrides: Sequence[str], launcher: str) -> int:
    """Members that run side by side: with joblib ``hydra.launcher.n_jobs``, by default one per core."""
    if launcher != "joblib":
        return 1
    text = _last(overrides, "hydra.launcher.n_jobs", "-1")
    if text != "-1" and (not text.isdecimal() or text == "0"):
        raise ConfigError(f"hydra.launcher.n_jobs={text}: must be an integer >= 1, or -1: one member per core")
    return (os.cpu_count() or 1) if text == "-1" else int(text)


def check(overrides: Sequence[str]) -> list[tuple[list[str], Config]]:
    """Settings and configuration of every member.

    Raises:
        ConfigError: one of them cannot run, or two of them would write to the same folder.
    """
    members = []
    for settings in expand(overrides):
        try:
            config = cli.compose_config([text for text in settings if not text.startswith("hydra")])
            address = config.hosts.coordinator
            if address != "none":
                raise ConfigError(f"hosts.coordinator={address}: a sweep's members have one process each; must be none")
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


def _resume(settings: Sequence[str]) -> str:
    """The command that resumes a member."""
    return shlex.join(["python", "-m", "rcg_jax.run", *settings])


def _write_outcome(folder: Path, settings: Sequence[str], code: int, message: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _OUTCOME).write_text(json.dumps({"settings": list(settings), "code": code, "message": message}))


def _member(composed: DictConfig) -> None:
    """A member that Hydra launched; a failure is written down and leaves the others alone."""
    from rcg_jax.cli.execute import execute

    here = HydraConfig.get()
    settings = list(here.overrides.task)
    print(f"\nsweep member {here.job.num}: {' '.join(settings)}", flush=True)
    try:
        code, message = execute(cli.compose_config(settings), _resume(settings), cli.given_names(settings))
    except Exception as error:  # the other members must run
        traceback.print_exc()
        code, message = 1, f"{type(error).__name__}: {one_line(error)}"
    except KeyboardInterrupt as stop:
        if str(here.launcher._target_).endswith("BasicLauncher"):  # in the sweep's own process, which stops
            raise
        code, message = getattr(stop, "exit_code", 130), str(stop) or "stopped"
    _write_outcome(Path(here.runtime.output_dir), settings, code, message)


def through_hydra(argv: Sequence[str]) -> None:
    """Runs Hydra's own entry point with ``argv``."""
    cli.register()
    main = hydra.main(version_base="1.3", config_path=None, config_name=cli.CONFIG_NAME)
    # HYDRA_FULL_ERROR: a launcher's exception comes through, instead of the end of the process.
    words = mock.patch.object(sys, "argv", [sys.argv[0], *argv])
    with words, mock.patch.dict(os.environ, HYDRA_FULL_ERROR="1"):
        main(_member)()


def _run_members(members: Sequence[list[str]], folder: Path, command: Sequence[str], jobs: int) -> None:
    """Runs members in processes of their own, so that a kill hits one only.

    A first Ctrl-C or SIGTERM lets those that run save and end, and the others do not begin; a second ends them at once.

    Args:
        members: their settings.
        folder: the sweep's, for the outcomes.
        command: what runs a member, before its settings.
        jobs: how many run side by side; if several, each line of their output is marked with its member.
    """
    running: set[subprocess.Popen[str]] = set()
    stopped = threading.Event()

    def handle(signum: int, frame: FrameType | None) -> None:
        stopped.set()
        for process in [*running] if signum == signal.SIGTERM else []:  # a terminal tells them of Ctrl-C itself
            process.terminate()

    def run(number: int) -> None:
        if stopped.is_set():
            return
        settings = [text for text in members[number] if not text.startswith("hydra")]
        print(f"\nsweep member {number}: {' '.join(settings)}", flush=True)
        output = subprocess.PIPE if jobs > 1 else None
        process = subprocess.Popen([*command, *settings], stdout=output, text=True, errors="replace")
        running.add(process)
        if stopped.is_set():  # meanwhile
            process.terminate()
        for line in process.stdout or ():
            print(f"[{number}] {line}", end="", flush=True)
        code = process.wait()
        running.remove(process)
        message = f"exit code {code}, see above"
        if code < 0:
            code, message = 128 - code, f"killed by {signal.Signals(-code).name}"
        elif code in (128 + signal.SIGINT, 128 + signal.SIGTERM):  # told to stop, and so is the sweep
            stopped.set()
            message = f"stopped by {signal.Signals(code - 128).name}"
        _write_outcome(folder / f"member-{number}", settings, code, message)

    with handling(handle), ThreadPoolExecutor(jobs) as pool:
        list(pool.map(run, range(len(members))))


def _command(argv: Sequence[str] | None) -> list[str]:
    """What started this process, without its settings; in a program that called ``run.main``, the module."""
    first = len(sys.orig_argv) - len(sys.argv) + 1
    if argv is not None or not sys.orig_argv or sys.orig_argv[first:] != sys.argv[1:]:
        return [sys.executable, "-m", "rcg_jax.run"]
    return [sys.executable, *sys.orig_argv[1:first]]


def run_sweep(request: cli.Request, argv: Sequence[str] | None = None) -> int:
    """Validates all members, runs them, and says which failed.

    Args:
        request: what the command line asks for.
        argv: the words of a program that calls ``run.main``; None: those of this process.

    Returns:
        Exit code: 1 if any failed, 128 + signal if any was stopped or killed.

    Raises:
        ConfigError: the settings of a member cannot be used; then none was started. What a task's class asks for
            beside them is looked at when its member begins.
    """
    launcher = check_launcher(request.overrides)
    jobs = _number_of_jobs(request.overrides, launcher)
    overrides = with_own_folders(request.overrides)
    members = [settings for settings, _ in check(overrides)]
    stamp = f"sweeps/{time.strftime('%Y-%m-%d_%H-%M-%S')}.{os.getpid()}"
    default = f"{_last(request.overrides, 'run_dir', Config().run_dir)}/{stamp}"
    folder = Path(_last(overrides, "hydra.sweep.dir", default))
    for left in folder.rglob(_OUTCOME):  # of an earlier sweep into this folder
        left.unlink()
    groups = [word for word in overrides if word.startswith("hydra/") and not word.startswith("hydra/launcher=")]
    if launcher in _OURS and not groups:
        _run_members(members, folder, _command(argv), jobs)
    else:
        try:
            through_hydra(["--multirun", *overrides, f"hydra.sweep.dir={_quoted(folder)}"])
        except (Exception, SystemExit) as error:  # the launcher's: a member's process was killed, say
            print(f"\nsweep: {launcher} gave up: {one_line(repr(error), 300)}")
    return _summary(len(members), folder)


def _summary(number: int, folder: Path) -> int:
    """Says what became of that many members; returns the exit code."""
    outcomes: list[dict[str, Any]] = [json.loads(path.read_text()) for path in folder.rglob(_OUTCOME)]
    finished = sum(outcome["code"] == 0 for outcome in outcomes)
    print(f"\nsweep: {finished} of {number} runs finished")
    for outcome in outcomes:
        if outcome["code"]:
            word = "failed: " if outcome["code"] < 128 else ""
            print(f"{word}{outcome['message']}\n  resume with: {_resume(outcome['settings'])}")
    if len(outcomes) < number:
        print(f"{number - len(outcomes)} did not end; the same command resumes them")
    if finished == number:
        return 0
    return max([1, *(outcome["code"] for outcome in outcomes if outcome["code"] > 128)])
