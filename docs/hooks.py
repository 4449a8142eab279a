"""Lets pages link to files of the repository: results become part of the site, other files links to the repository.

The notebook ``tour.ipynb`` becomes a page: its text, its code, and the outputs that are committed with it.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"(\]\()\.\./([^)#\s]+)(#[^)\s]+)?(\))")


def on_files(files: Files, config: Any) -> Files:
    """Adds ``experiments/results`` and the page of the notebook to the site."""
    for path in sorted((ROOT / "experiments" / "results").iterdir()):
        if path.suffix in (".png", ".gif", ".csv"):
            files.append(File.generated(config, f"results_files/{path.name}", abs_src_path=str(path)))
    pictures: dict[str, bytes] = {}
    page = _notebook_page(json.loads((ROOT / "docs" / "tour.ipynb").read_text()), pictures)
    files.append(File.generated(config, "tour.md", content=page))
    for name, content in pictures.items():
        files.append(File.generated(config, name, content=content))
    return files


def _notebook_page(notebook: dict[str, Any], pictures: dict[str, bytes]) -> str:
    """A notebook as Markdown; its pictures are added to ``pictures``, path -> content."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                name = f"tour_files/{len(pictures)}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![output of the code above]({name})")
            elif "text/html" in data:
                parts.append("".join(data["text/html"]))
            else:
                parts.append(f"```text\n{''.join(data['text/plain']).rstrip()}\n```")
    first, *rest = parts
    return "\n\n".join([first, "This page is a notebook: [download it](tour.ipynb).", *rest]) + "\n"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Replaces ``../`` links, and refuses those to nothing."""

    def replaced(match: re.Match[str]) -> str:
        begin, target, anchor, end = match.groups()
        if not (ROOT / target).exists():
            raise PluginError(f"{page.file.src_path}: ../{target} does not exist")
        if target.startswith("experiments/results/") and Path(target).suffix in (".png", ".gif", ".csv"):
            return f"{begin}results_files/{Path(target).name}{end}"
        return f"{begin}{config['repo_url']}/blob/main/{target}{anchor or ''}{end}"

    if page.file.src_path != "tour.md":  # which offers the notebook itself
        markdown = markdown.replace("](tour.ipynb)", "](tour.md)")
    return _LINK.sub(replaced, markdown)
