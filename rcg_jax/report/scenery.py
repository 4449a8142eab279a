"""What does not move in a model, in outline: walls, pegs and locks behind the starts."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

#: Corners of a unit cube, (8, 3).
_CUBE = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T

#: Directions on a unit sphere, (K, 3).
_SPHERE = np.array(
    [
        [np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)]
        for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)
        for b in np.linspace(-np.pi / 2, np.pi / 2, 9)
    ]
)


def _surface(kind: int, size: np.ndarray, vertices: np.ndarray) -> np.ndarray | None:
    """Points (K, 3) of a geom's frame whose convex hull is the geom, or nearly; None for what has no outline."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_BOX:
        return _CUBE * size
    if kind == types.mjGEOM_SPHERE:
        return _SPHERE * size[0]
    if kind == types.mjGEOM_ELLIPSOID:
        return _SPHERE * size
    ends = np.array([[0, 0, size[1]], [0, 0, -size[1]]])
    if kind == types.mjGEOM_CAPSULE:
        return (_SPHERE * size[0] + ends[:, None]).reshape(-1, 3)
    if kind == types.mjGEOM_CYLINDER:
        circle = _SPHERE[_SPHERE[:, 2].round(9) == 0] * size[0]
        return (circle + ends[:, None]).reshape(-1, 3)
    if kind == types.mjGEOM_MESH:
        return vertices
    return None  # planes and height fields: the ground


def static_geoms(model: mujoco.MjModel) -> list[np.ndarray]:
    """Points (K, 3) in the world [m] that span each geom that never moves and is drawn."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in range(model.ngeom):
        # Group 3 and beyond is what MuJoCo's own pictures leave out.
        if model.body_weldid[model.geom_bodyid[geom]] or model.geom_group[geom] >= 3 or model.geom_rgba[geom, 3] < 0.05:
            continue
        mesh = model.geom_dataid[geom]
        vertices = np.zeros((0, 3))
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and mesh >= 0:
            first = model.mesh_vertadr[mesh]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        surface = _surface(model.geom_type[geom], model.geom_size[geom], vertices)
        if surface is not None and len(surface):
            found.append(surface @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return found


def outline(surface: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """The corners (K, 2) [m], in order, of what points (N, 3) look like along the third axis; may be none."""
    flat = surface[:, axes]
    try:
        return flat[ConvexHull(flat).vertices]
    except QhullError:  # seen from its edge
        return np.zeros((0, 2))
