"""Runs a notebook's code cells and keeps what they show, without Jupyter.

``python -m tests.notebook docs/tour.ipynb`` renews the outputs that are committed with it.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

_DPI = 75


def execute(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Runs the code cells in order, in the working directory; sets their outputs, returns the names they define."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {"__name__": "__main__"}
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, 1):
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        value, printed = None, io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, f"cell {number}", "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            lines = printed.getvalue().splitlines(keepends=True)
            outputs.append({"output_type": "stream", "name": "stdout", "text": lines})
        for figure in map(plt.figure, plt.get_fignums()):
            data = {"image/png": _png(figure), "text/plain": ["<figure>"]}
            outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
        plt.close("all")
        if value is not None:
            data = {"text/plain": repr(value).splitlines(keepends=True)}
            if hasattr(value, "_repr_html_"):
                data["text/html"] = value._repr_html_().splitlines(keepends=True)
            outputs.append({"output_type": "execute_result", "execution_count": number, "data": data, "metadata": {}})
        cell.update(execution_count=number, outputs=outputs)
    return names


def _png(figure: Any) -> str:
    from PIL import Image

    picture, small = io.BytesIO(), io.BytesIO()
    figure.savefig(picture, dpi=_DPI, bbox_inches="tight")
    Image.open(picture).convert("RGB").quantize(64).save(small, "png", optimize=True)
    return base64.b64encode(small.getvalue()).decode()


def main(path: Path) -> None:
    """Executes a notebook in a temporary folder and writes it with its outputs."""
    path = path.absolute()
    notebook = json.loads(path.read_text())
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        execute(notebook["cells"])
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
