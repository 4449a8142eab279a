"""Puts a page together: one file with its styles, its program, Chart.js and its data."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from typing import Any


def _asset(name: str) -> str:
    return (files("rcg_jax.report") / "assets" / name).read_text(encoding="utf-8")


def page(title: str, data: dict[str, Any]) -> str:
    """The HTML of a page that shows ``data`` by ``assets/page.js``, which takes its texts as text, never as HTML."""
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _asset("page.css"),
        # Inside a script element "<" could end it, whatever it stands in.
        "DATA": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "CHART": _asset("chart.umd.min.js"),
        "STARTS": _asset("starts.js"),
        "PAGE": _asset("page.js"),
    }
    # Split, not replaced one after the other: what a part contains is never looked at again.
    pieces = _asset("page.html").split("@@")
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))
