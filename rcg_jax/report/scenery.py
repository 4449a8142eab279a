"""What does not move in a model, in outline: walls, pegs and locks behind the starts."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

#: Corners of a unit cube, (8, 3).
_CUBE = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T

#: Points on a unit sphere and on its equator, (K, 3).
_A, _B = np.meshgrid(np.linspace(0, 2 * np.pi, 24, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 9))
_SPHERE = np.stack([np.cos(_A) * np.cos(_B), np.sin(_A) * np.cos(_B), np.sin(_B)], axis=-1).reshape(-1, 3)
_CIRCLE = np.stack([np.cos(_A[0]), np.sin(_A[0]), 0 * _A[0]], axis=-1)


def _surface(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points (K, 3) of a geom's frame whose convex hull is the geom, or nearly; none of what has no outline."""
    kind, size, types = int(model.geom_type[geom]), model.geom_size[geom], mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        return model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    ends = np.array([[[0, 0, size[1]]], [[0, 0, -size[1]]]])
    surfaces = {
        types.mjGEOM_BOX: _CUBE * size,
        types.mjGEOM_SPHERE: _SPHERE * size[0],
        types.mjGEOM_ELLIPSOID: _SPHERE * size,
        types.mjGEOM_CAPSULE: (_SPHERE * size[0] + ends).reshape(-1, 3),
        types.mjGEOM_CYLINDER: (_CIRCLE * size[0] + ends).reshape(-1, 3),
    }
    return surfaces.get(kind, np.zeros((0, 3)))  # planes and height fields are the ground


def static_geoms(model: mujoco.MjModel) -> list[np.ndarray]:
    """Points (K, 3) in the world [m] that span each geom that never moves and is drawn."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in range(model.ngeom):
        # Group 3 and beyond is what MuJoCo's own pictures leave out.
        if model.body_weldid[model.geom_bodyid[geom]] or model.geom_group[geom] >= 3 or model.geom_rgba[geom, 3] < 0.05:
            continue
        surface = _surface(model, geom)
        if len(surface):
            found.append(surface @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return found


def outline(surface: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """The corners (K, 2) [m], in order, of what points (N, 3) look like along the third axis; may be none."""
    flat = surface[:, axes]
    try:
        return flat[ConvexHull(flat).vertices]
    except QhullError:  # seen from its edge
        return np.zeros((0, 2))
