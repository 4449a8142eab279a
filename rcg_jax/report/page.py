"""Puts a page together: one file with its styles, its program, Chart.js and its data."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from rcg_jax.io.tables import write_atomically


def _asset(name: str) -> str:
    return (files("rcg_jax.report") / "assets" / name).read_text(encoding="utf-8")


def page(title: str, data: dict[str, Any]) -> str:
    """The HTML text of a page.

    Args:
        title: of the window.
        data: what ``assets/page.js`` shows. It puts text into the page as text, never as HTML.
    """
    # Inside a script element "<" could end it, whatever it stands in.
    content = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _asset("page.css"),
        "DATA": content,
        "CHART": _asset("chart.umd.min.js"),
        "STARTS": _asset("starts.js"),
        "PAGE": _asset("page.js"),
    }
    # Split, not replaced one after the other: what a part contains is never looked at again.
    pieces = _asset("page.html").split("@@")
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))


def write_page(path: Path, title: str, data: dict[str, Any]) -> None:
    """Writes a page; a reader sees the old or the new one.

    Raises:
        OSError: it cannot be written.
    """
    write_atomically(path, page(title, data).encode())
