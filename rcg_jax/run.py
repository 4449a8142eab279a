"""``python -m rcg_jax.run task=ring_peg``: trains, or continues, a run. ``--help`` lists every setting.

Exit codes: 0 done; 1 failed; 2 settings refused, before anything was begun; 130 or 143 stopped by a signal, saved.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence

import rcg_jax
from rcg_jax.cli.execute import execute, failed
from rcg_jax.config import compose as cli
from rcg_jax.config.settings import ConfigError
from rcg_jax.io.console import lenient_output


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code.

    Args:
        argv: its words. Programs that train in their own process, notebooks for instance, give them; then an
            interruption does not end the process, and JAX's settings are as before.
    """
    alone = argv is None
    if not alone:
        rcg_jax.STARTED = time.monotonic()  # not the import, which may be long ago
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        request = cli.parse(argv)
        if request.help:
            if hasattr(signal, "SIGPIPE"):
                signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # --help | head is no error
            print(cli.help_text())
            return 0
        if request.hydra:
            from rcg_jax.cli.sweep import check, through_hydra

            check(request.overrides)
            through_hydra(argv)
            return 0
        if request.multirun:
            from rcg_jax.cli.sweep import run_sweep

            return run_sweep(request, None if alone else argv)
        config = cli.compose_config(request.overrides)
        command = shlex.join(["python", "-m", "rcg_jax.run", *argv])
        return execute(config, command, cli.given_names(request.overrides))[0]
    except ConfigError as error:
        return failed(2, error)[0]
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
