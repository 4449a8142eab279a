"""Lets pages link to files of the repository: results become part of the site, other files links to the repository."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"(\]\()\.\./([^)#\s]+)(#[^)\s]+)?(\))")


def on_files(files: Files, config: Any) -> Files:
    """Adds ``experiments/results`` to the site."""
    for path in sorted((ROOT / "experiments" / "results").iterdir()):
        if path.suffix in (".png", ".gif", ".csv"):
            files.append(File.generated(config, f"results_files/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Replaces ``../`` links, and refuses those to nothing."""

    def replaced(match: re.Match[str]) -> str:
        begin, target, anchor, end = match.groups()
        if not (ROOT / target).exists():
            raise PluginError(f"{page.file.src_path}: ../{target} does not exist")
        if target.startswith("experiments/results/") and Path(target).suffix in (".png", ".gif", ".csv"):
            return f"{begin}results_files/{Path(target).name}{end}"
        return f"{begin}{config['repo_url']}/blob/main/{target}{anchor or ''}{end}"

    return _LINK.sub(replaced, markdown)
