"""``python -m rcg_jax.run task=ring_peg``: trains, or continues, a run. ``--help`` lists every setting.

Exit codes: 0 done; 1 failed; 2 settings refused, before anything was begun; 130 or 143 stopped by a signal, saved.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import traceback
from collections.abc import Collection, Sequence

from rcg_jax import cli
from rcg_jax.config import Config, ConfigError
from rcg_jax.console import lenient_output, tell


def execute(config: Config, command: str, given: Collection[str]) -> tuple[int, str]:
    """Runs one configuration and reports what goes wrong in one line.

    Args:
        config: validated settings.
        command: what resumes this run.
        given: names of the settings that the user set; the task's class may have its own say on the others.

    Returns:
        Exit code and, where it is not 0, the reason.

    Raises:
        Interrupted: asked to stop; saved.
    """
    # JAX is imported from here on, when the settings are known to be good.
    from rcg_jax.hosts import ALONE, ConnectError, connect
    from rcg_jax.interrupt import Interrupted
    from rcg_jax.loop import RunError, run
    from rcg_jax.program import jax_settings_kept, prepare
    from rcg_jax.progress import Reporter
    from rcg_jax.task_settings import with_task_settings

    hosts, code, message = ALONE, 0, ""
    try:
        hosts = connect(config.hosts)
        with jax_settings_kept():
            prepare(config)  # as the connection before the class of a task is imported, which may compute something
            config = with_task_settings(config, given)
            run(config, report=Reporter(quiet=not hosts.is_first), command=command, hosts=hosts)
    except ConfigError as error:
        code, message = _failed(2, error)
    except (RunError, ConnectError) as error:
        code, message = _failed(1, error)
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


def _failed(code: int, error: Exception) -> tuple[int, str]:
    tell(error)
    return code, str(error)


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code.

    Args:
        argv: its words. Programs that train in their own process, notebooks for instance, give them; then an
            interruption does not end the process, and JAX's settings are as before.
    """
    alone = argv is None
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        request = cli.parse(argv)
        if request.help:
            if hasattr(signal, "SIGPIPE"):
                signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # --help | head is no error
            print(cli.help_text())
            return 0
        if request.hydra:
            from rcg_jax.sweep import check, through_hydra

            check(request.overrides)
            through_hydra(argv)
            return 0
        if request.multirun:
            from rcg_jax.sweep import run_sweep

            return run_sweep(request)
        config = cli.compose_config(request.overrides)
        command = shlex.join(["python", "-m", "rcg_jax.run", *argv])
        return execute(config, command, cli.given_names(request.overrides))[0]
    except ConfigError as error:
        return _failed(2, error)[0]
    except KeyboardInterrupt as stop:
        code = getattr(stop, "exit_code", 130)
        if not alone:
            return int(code)
        # A thread may still be inside the compiler, which only the end of the process ends; all files are closed.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    sys.exit(main())
