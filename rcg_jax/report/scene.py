"""Pictures of a model's states, drawn by MuJoCo without a display."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from rcg_jax.io.manifest import brief

if TYPE_CHECKING:  # `import mujoco` itself fails where MUJOCO_GL asks for a library that is not installed
    import mujoco

    from rcg_jax.tasks.base import Task


class RenderError(RuntimeError):
    """Nothing can be drawn on this machine. The message is one line that says what is missing."""


def no_gl(error: BaseException) -> RenderError:
    """What to say about an exception on the way to an OpenGL context."""
    backend = f"MUJOCO_GL={os.environ['MUJOCO_GL']}: " if os.environ.get("MUJOCO_GL") else ""
    advice = "drawing needs the Debian packages libegl1 libegl-mesa0 libgl1-mesa-dri: make apt installs them"
    return RenderError(f"no OpenGL context ({backend}{brief(error)}); {advice}")


@contextmanager
def open_scene(
    model: mujoco.MjModel, width: int, height: int, camera: str
) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """Yields a function from positions (nq,) to an off-screen picture (height, width, 3) uint8.

    The model is copied. ``camera`` is the name of one of its cameras; any other name: MuJoCo's free camera.

    Raises:
        RenderError: this machine cannot draw.
    """
    import mujoco

    model = copy.deepcopy(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    data = mujoco.MjData(model)
    has_camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera) >= 0
    try:
        _use_egl_without_display()
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # every library between here and the driver has its own
        raise no_gl(error) from None

    def draw(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, camera if has_camera else -1)
        return renderer.render().copy()

    try:
        yield draw
    finally:
        renderer.close()


def _use_egl_without_display() -> None:
    """Draws through EGL where MUJOCO_GL is unset and there is no display. Works after mujoco was imported, too."""
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    if os.environ.setdefault("MUJOCO_GL", "egl") == "egl":
        # MuJoCo reads the variable when it is imported, which may have been long ago.
        from mujoco.egl import GLContext
        from mujoco.rendering.classic import gl_context

        gl_context.GLContext = GLContext


def render_still(
    task: Task, qpos: np.ndarray, *, width: int = 640, height: int = 480, camera: str = "overview"
) -> np.ndarray:
    """One picture (height, width, 3) uint8 of a task in the state ``qpos`` (nq,); save it with ``imageio.imwrite``.

    Raises:
        RenderError: this machine cannot draw.
    """
    with open_scene(task.model, width, height, camera) as draw:
        return draw(qpos)
