"""Where the MJCF files, the shipped start sets and policies lie, in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]

#: Folder of the MJCF files: inside the package in a wheel, beside it in a checkout.
XML = _PACKAGE / "xml" if (_PACKAGE / "xml").is_dir() else _PACKAGE.parent / "xml"

#: Folder of the feasible start sets.
DATA = _PACKAGE / "data"

#: Folder of the trained policies.
POLICIES = DATA / "policies"
