"""The one place that imports MJX, which prints two lines where NVIDIA's optional warp package is not installed."""

from __future__ import annotations

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver  # which geoms collide is not public; the version is pinned

__all__ = ["collision_driver", "mjx"]
