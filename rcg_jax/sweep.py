"""Sweeps: ``-m`` with several values of a field, one run per combination, through Hydra's launchers."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcg_jax import cli
from rcg_jax.config import Config, ConfigError
from rcg_jax.own_name import class_name

_OUTCOME = "outcome.json"

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


def check(overrides: Sequence[str]) -> list[tuple[list[str], Config]]:
    """Settings and configuration of every member.

    Raises:
        ConfigError: one of them cannot run, or two of them would write to the same folder.
    """
    members = []
    for settings in expand(overrides):
        try:
            own = [text for text in settings if not text.startswith("hydra")]
            members.append((settings, cli.compose_config(own)))
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


def _member(composed: DictConfig) -> None:
    """One run of a sweep; a failure is written down and leaves the others alone."""
    from rcg_jax.run import execute

    here = HydraConfig.get()
    settings = list(here.overrides.task)
    command = shlex.join(["python", "-m", "rcg_jax.run", *settings])
    print(f"\nsweep member {here.job.num}: {' '.join(settings)}", flush=True)
    try:
        code, message = execute(cli.from_hydra(composed), command)
    except Exception as error:  # the other members must run
        traceback.print_exc()
        code, message = 1, f"{type(error).__name__}: {' '.join(str(error).split())}"
    outcome = {"settings": settings, "code": code, "message": message}
    (Path(here.runtime.output_dir) / _OUTCOME).write_text(json.dumps(outcome))


def through_hydra(argv: Sequence[str]) -> None:
    """Runs Hydra's own entry point with ``argv``."""
    cli.register()
    before = sys.argv
    sys.argv = [before[0], *argv]
    try:
        hydra.main(version_base="1.3", config_path=None, config_name=cli.CONFIG_NAME)(_member)()
    finally:
        sys.argv = before


def run_sweep(request: cli.Request) -> int:
    """Validates all members, runs them, and says which failed.

    Returns:
        Exit code: 1 if any failed.

    Raises:
        ConfigError: a member cannot run; then none was started.
        Interrupted: asked to stop.
    """
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
    through_hydra(["--multirun", *request.hydra, *overrides])
    outcomes = [json.loads(path.read_text()) for path in folder.rglob(_OUTCOME)]
    finished = sum(outcome["code"] == 0 for outcome in outcomes)
    print(f"\nsweep: {finished} of {len(members)} runs finished")
    for outcome in outcomes:
        if outcome["code"]:
            command = shlex.join(["python", "-m", "rcg_jax.run", *outcome["settings"]])
            print(f"failed: {outcome['message']}\n  resume with: {command}")
    if len(outcomes) < len(members):
        print(f"{len(members) - len(outcomes)} did not end; the same command resumes them")
    return 0 if finished == len(members) else 1
