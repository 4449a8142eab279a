"""The one place that imports MJX.

Without NVIDIA's optional warp package ``import mujoco.mjx`` prints two lines on stdout that say so. They are dropped
here, and only they: whatever else is printed on the way still appears, and exceptions are not touched.
"""

from __future__ import annotations

import contextlib
import io
import sys

_EXPECTED = ("Failed to import warp: No module named 'warp'", "Failed to import mujoco_warp: No module named 'warp'")

_printed = io.StringIO()
try:
    with contextlib.redirect_stdout(_printed):
        from mujoco import mjx
        from mujoco.mjx._src import collision_driver  # which geoms collide is not public; the version is pinned
finally:
    for _line in _printed.getvalue().splitlines():
        if _line not in _EXPECTED:
            print(_line, file=sys.stdout)

__all__ = ["collision_driver", "mjx"]
