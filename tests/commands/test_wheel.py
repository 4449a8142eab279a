"""What is published: wheel and sdist hold all that a run needs."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_one_iteration_from_the_sdist_s_wheel(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    made = subprocess.run(
        [sys.executable, "-m", "build", "--outdir", str(tmp_path), str(ROOT)], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr[-2000:]
    (sdist,), (wheel,) = tmp_path.glob("*.tar.gz"), tmp_path.glob("*.whl")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "CHANGELOG.md", "CITATION.cff", "xml/ring_peg.xml", "tests/commands/test_wheel.py"} <= names
    installed = tmp_path / "installed"
    subprocess.run([*build, "install", "--quiet", "--no-deps", "--target", str(installed), str(wheel)], check=True)
    assert (installed / "rcg_jax" / "py.typed").exists()
    words = "task=point_maze iterations=1 eval_every=0 evaluation.final_episodes=10 write_report=false run_dir=runs "
    words += "trpo.iterations=1 rollout.num_envs=2 rollout.batch_size=1000 baseline.minibatch_size=500"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, rcg_jax.run as r; print(r.__file__); sys.exit(r.main(sys.argv[1:]))",
            *words.split(),
        ],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "success on rho_0" in done.stdout
    assert Path(done.stdout.splitlines()[0]).is_relative_to(installed)
