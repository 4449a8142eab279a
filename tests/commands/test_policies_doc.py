"""The example of docs/policies.md in MuJoCo alone needs nothing of this package."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from rcg_jax import export
from rcg_jax.io.assets import POLICIES
from tests.commands.test_own_task import ROOT

DOC = (ROOT / "docs" / "policies.md").read_text()
_, MUJOCO = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)


def test_the_example_in_mujoco_alone_reaches_the_goal(tmp_path: Path) -> None:
    assert sum(bool(line) for line in MUJOCO.splitlines()) <= 20
    (line,) = re.findall(r"rcg export (task=.*)", DOC)
    words = [word.replace("out=", f"out={tmp_path}/") for word in shlex.split(line)]
    assert export.main(words) == 0
    for suffix in (".npz", ".json"):
        shutil.copy(POLICIES / f"point_maze{suffix}", tmp_path)
    # Outside the repository, so that nothing of this package could be imported from there.
    done = subprocess.run(
        [sys.executable, "-c", f"{MUJOCO}\nimport sys; assert 'rcg_jax' not in sys.modules"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[0]) < 0.3
