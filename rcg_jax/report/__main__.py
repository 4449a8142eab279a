"""``python -m rcg_jax.report run=DIR`` writes a run's report; ``run=A run=B ... [out=FILE]`` compares runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rcg_jax.config.arguments import output_file, run_command
from rcg_jax.config.settings import option

_NAME = "comparison.html"


@dataclass(frozen=True)
class ReportOptions:
    """Settings of ``python -m rcg_jax.report``."""

    run: str = option("", "folder of a seed, or of a method for all of its seeds; several run=... are compared")
    out: str = option("", f"file to write; default: report.html in the run's folder; of a comparison: {_NAME} here")
    videos: int = option(3, "successes and failures shown in the videos, at most; 0: no videos", low=0, high=20)


def _report(options: ReportOptions, words: Sequence[str]) -> None:
    # Imported here: help and refusals come at once.
    from rcg_jax.report.compare import find_runs, write_comparison

    out = output_file(options.out, ".html", ".htm")
    paths = find_runs([Path(word.partition("=")[2]) for word in words if word.startswith("run=")])
    if len(paths) > 1:
        out = out or Path(_NAME)
        labels = write_comparison(paths, out)
        print(f"{out}: {len(paths)} runs in {len(labels)} group{'s' * (len(labels) > 1)}: {'; '.join(labels)}")
        return
    import jax

    from rcg_jax.physics.jit import enable_compilation_cache
    from rcg_jax.report.write import write_report

    jax.config.update("jax_platforms", "cpu")  # a few episodes, whatever the run was trained on
    enable_compilation_cache()
    out = out or paths[0] / "report.html"
    print(f"{paths[0]}: writing the report ...", flush=True)
    for line in write_report(paths[0], out, videos=options.videos):
        print(line)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code (2: it cannot be done as asked, said in one line)."""
    return run_command(ReportOptions, "rcg_jax.report", argv, _report)


if __name__ == "__main__":
    sys.exit(main())
