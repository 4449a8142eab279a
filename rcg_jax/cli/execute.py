"""Running one configuration, from validated settings to an exit code."""

from __future__ import annotations

import traceback
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

from rcg_jax.config import Config, ConfigError
from rcg_jax.io.console import tell


def execute(config: Config, command: str, given: Collection[str]) -> tuple[int, str]:
    """Runs one configuration; returns the exit code and, where it is not 0, the reason, which is also printed.

    Args:
        config: validated settings.
        command: what resumes this run.
        given: names of the settings that the user set; the task's class may have its own say on the others.

    Raises:
        Interrupted: asked to stop; saved.
    """
    # JAX is imported from here on, when the settings are known to be good.
    from rcg_jax.runs.engine import choose_engine
    from rcg_jax.runs.interrupt import Interrupted
    from rcg_jax.runs.program import jax_settings_kept, load_program, prepare
    from rcg_jax.runs.progress import Reporter
    from rcg_jax.runs.train import RunError, run
    from rcg_jax.sharding.hosts import ALONE, ConnectError, connect
    from rcg_jax.tasks.training import resolve

    hosts, code, message = ALONE, 0, ""
    try:
        hosts = connect(config.hosts)
        with jax_settings_kept():
            config, why = choose_engine(config)
            prepare(config)  # as the connection before the class of a task is imported, which may compute something
            config, asked = resolve(config, given)
            reporter = Reporter(quiet=not hosts.is_first)
            if why:
                reporter.say(why)
            run(
                config,
                report=reporter,
                command=command,
                load=partial(load_program, pictures=_pictures, report=_report),
                hosts=hosts,
                asked=asked,
            )
    except ConfigError as error:
        code, message = failed(2, error)
    except (RunError, ConnectError) as error:
        code, message = failed(1, error)
    except Interrupted:
        hosts.part()  # the first process may still be saving
        raise
    except Exception:
        if hosts.number == 1:
            raise
        traceback.print_exc()
        code = 1
    if code and hosts.number > 1:
        hosts.leave(code)
    return code, message


def failed(code: int, error: Exception) -> tuple[int, str]:
    """Says why a command failed; returns exit code and reason."""
    tell(error)
    return code, str(error)


def _pictures(folder: Path) -> None:
    # Imported when a run has ended: a broken plotting library must not keep one from training.
    from rcg_jax.report.plots import write_run_pictures

    write_run_pictures(folder)


def _report(folder: Path) -> Sequence[str]:
    from rcg_jax.report.write import write_report

    return write_report(folder)
