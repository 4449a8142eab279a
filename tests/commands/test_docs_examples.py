"""The Python examples of docs/trainers.md run as they stand; those of packages that are not installed are skipped."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "trainers.md"
EXAMPLES = re.findall(r"^## (.*?)$.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("code", [pytest.param(code, id=title) for title, code in EXAMPLES])
def test_example(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("stable_baselines3", "torch", "brax"):
        uses = re.search(rf"^\s*(import|from) {package}\b|rcg_jax\.{package}\b", code, re.MULTILINE)
        if uses and importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(PAGE), "exec"), {"__name__": "__main__"})


def test_every_section_with_code_is_here() -> None:
    assert len(EXAMPLES) == PAGE.read_text().count("```python")
