"""Contacts between pairs of geoms, as C MuJoCo finds them: same points, same normals, same use of the margin.

MJX's own capsule-box collider ignores the margin and picks other points than C MuJoCo, so that two engines with the
same model would not be the same task. Here the batch of B environments is the last axis, which a CPU turns into vector
instructions.

Every collider takes two :class:`Geoms` of P pairs, the one of the lower MuJoCo type first, and returns
:class:`Contacts` of K points per pair, whether they act or not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

_TINY = 1e-12
_NONE = 4.0  # in place of a position in [-1, 1] on a segment: no such point


class Geoms(NamedTuple):
    """One side of P pairs: position (3, P, B), rotation (3, 3, P, B), and size (P, 3) [m], a constant."""

    pos: Array
    mat: Array
    size: np.ndarray


class Contacts(NamedTuple):
    """K points of P pairs: dist (K, P, B) [m], pos and normal (3, K, P, B); the normal points from first to second."""

    dist: Array
    pos: Array
    normal: Array


def plane_sphere(plane: Geoms, sphere: Geoms) -> Contacts:
    """One point."""
    return _plane_points(plane, sphere.pos[:, None], sphere.size[:, 0, None])


def plane_capsule(plane: Geoms, capsule: Geoms) -> Contacts:
    """Two points, one per end."""
    half = capsule.mat[:, 2] * capsule.size[:, 1, None]
    return _plane_points(plane, jnp.stack([capsule.pos + half, capsule.pos - half], 1), capsule.size[:, 0, None])


def plane_box(plane: Geoms, box: Geoms) -> Contacts:
    """Four points: of each pair of opposite corners the one further down."""
    normal = plane.mat[:, 2]
    points = []
    for signs in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)):
        x, y, z = (s * box.size[:, k, None] * box.mat[:, k] for k, s in enumerate(signs))
        corner = x + y + z
        points.append(box.pos + jnp.where(_dot(corner, normal) > 0, -corner, corner))
    return _plane_points(plane, jnp.stack(points, 1), 0.0)


def sphere_sphere(first: Geoms, second: Geoms) -> Contacts:
    """One point."""
    return _spheres(first.pos, first.size[:, 0, None], second.pos, second.size[:, 0, None])


def sphere_capsule(sphere: Geoms, capsule: Geoms) -> Contacts:
    """One point."""
    half = capsule.mat[:, 2] * capsule.size[:, 1, None]
    x = _dot(half, sphere.pos - capsule.pos) / jnp.maximum(_dot(half, half), _TINY)
    nearest = capsule.pos + jnp.clip(x, -1.0, 1.0) * half
    return _spheres(sphere.pos, sphere.size[:, 0, None], nearest, capsule.size[:, 0, None])


def capsule_capsule(first: Geoms, second: Geoms) -> Contacts:
    """One point. (C MuJoCo gives two where the axes are exactly parallel.)"""
    half1, half2 = (g.mat[:, 2] * g.size[:, 1, None] for g in (first, second))
    x1, x2 = _segments(half1, half2, second.pos - first.pos)
    return _spheres(first.pos + x1 * half1, first.size[:, 0, None], second.pos + x2 * half2, second.size[:, 0, None])


def sphere_box(sphere: Geoms, box: Geoms) -> Contacts:
    """One point."""
    local = _local(box, sphere.pos - box.pos)
    return _world(box, *_sphere_box(local[:, None], sphere.size[:, 0, None], _sizes(box)))


def capsule_box(capsule: Geoms, box: Geoms) -> Contacts:
    """Two points: where the capsule's axis is nearest to the box, and how far it then stays above a face of it."""
    size = _sizes(box)
    center = _local(box, capsule.pos - box.pos)
    half = _local(box, capsule.mat[:, 2]) * capsule.size[:, 1, None]
    first, second = _nearest_two(center, half, size)
    points = jnp.stack([center + first * half, center + second * half], 1)
    dist, pos, normal = _sphere_box(points, capsule.size[:, 0, None], size)
    dist = dist.at[1].set(jnp.where(second == _NONE, jnp.inf, dist[1]))
    return _world(box, dist, pos, normal)


_TYPE = mujoco.mjtGeom

#: (collider, K points) by the types of both geoms.
COLLIDERS: dict[tuple[int, int], tuple[Callable[[Geoms, Geoms], Contacts], int]] = {
    (int(_TYPE.mjGEOM_PLANE), int(_TYPE.mjGEOM_SPHERE)): (plane_sphere, 1),
    (int(_TYPE.mjGEOM_PLANE), int(_TYPE.mjGEOM_CAPSULE)): (plane_capsule, 2),
    (int(_TYPE.mjGEOM_PLANE), int(_TYPE.mjGEOM_BOX)): (plane_box, 4),
    (int(_TYPE.mjGEOM_SPHERE), int(_TYPE.mjGEOM_SPHERE)): (sphere_sphere, 1),
    (int(_TYPE.mjGEOM_SPHERE), int(_TYPE.mjGEOM_CAPSULE)): (sphere_capsule, 1),
    (int(_TYPE.mjGEOM_SPHERE), int(_TYPE.mjGEOM_BOX)): (sphere_box, 1),
    (int(_TYPE.mjGEOM_CAPSULE), int(_TYPE.mjGEOM_CAPSULE)): (capsule_capsule, 1),
    (int(_TYPE.mjGEOM_CAPSULE), int(_TYPE.mjGEOM_BOX)): (capsule_box, 2),
}


def _dot(a: Array, b: Array) -> Array:
    """Product of vectors on the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sizes(box: Geoms) -> Array:
    """Half sizes (3, P, 1)."""
    return jnp.asarray(box.size.T[:, :, None], jnp.float32)


def _local(box: Geoms, vector: Array) -> Array:
    """World vectors (3, P, B) in the axes of the boxes."""
    return jnp.stack([_dot(box.mat[:, k], vector) for k in range(3)])


def _world(box: Geoms, dist: Array, pos: Array, normal: Array) -> Contacts:
    """Contacts in the world, from points and normals (3, K, P, B) in the axes of the boxes."""

    def turn(v: Array) -> Array:
        x, y, z = (box.mat[:, k, None] * v[k] for k in range(3))
        return x + y + z

    return Contacts(dist, box.pos[:, None] + turn(pos), turn(normal))


def _plane_points(plane: Geoms, points: Array, radius: np.ndarray | float) -> Contacts:
    """Spheres (3, K, P, B) above planes."""
    normal = jnp.broadcast_to(plane.mat[:, 2, None], points.shape)
    dist = _dot(points - plane.pos[:, None], normal) - radius
    return Contacts(dist, points - normal * (0.5 * dist + radius), normal)


def _spheres(pos1: Array, radius1: np.ndarray, pos2: Array, radius2: np.ndarray) -> Contacts:
    """Two spheres; (3, P, B) each."""
    apart = pos2 - pos1
    length = jnp.sqrt(jnp.maximum(_dot(apart, apart), _TINY))
    normal = apart / length
    dist = length - radius1 - radius2
    pos = pos1 + normal * (radius1 + 0.5 * dist)
    return Contacts(dist[None], pos[:, None], normal[:, None])


def _segments(half1: Array, half2: Array, apart: Array) -> tuple[Array, Array]:
    """Nearest points of two segments, in [-1, 1] of their half axes; ``apart`` leads from centre 1 to centre 2."""
    a, b, c = _dot(half1, half1), _dot(half1, half2), _dot(half2, half2)
    u, v = _dot(half1, apart), _dot(half2, apart)
    x1 = jnp.clip((c * u - b * v) / jnp.maximum(a * c - b * b, _TINY), -1.0, 1.0)
    x2 = jnp.clip((b * x1 - v) / jnp.maximum(c, _TINY), -1.0, 1.0)
    return jnp.clip((b * x2 + u) / jnp.maximum(a, _TINY), -1.0, 1.0), x2


def _sphere_box(center: Array, radius: np.ndarray, size: Array) -> tuple[Array, Array, Array]:
    """Spheres (3, K, P, B) against boxes, both in the axes of the box: dist, pos, normal from sphere to box."""
    size = size[:, None]
    nearest = jnp.clip(center, -size, size)
    toward = nearest - center
    length = jnp.sqrt(_dot(toward, toward))
    inside = length <= 1e-9
    # A centre inside leaves through the nearest face.
    gap = size - jnp.abs(center)
    least = jnp.min(gap, axis=0)
    inward = -jnp.sign(center) * (gap == least)
    normal = jnp.where(inside, inward, toward / jnp.maximum(length, 1e-9))
    pos = jnp.where(inside, center + 0.5 * (radius - least) * inward, 0.5 * (nearest + center + normal * radius))
    return jnp.where(inside, -least, length) - radius, pos, normal


def _nearest_two(center: Array, half: Array, size: Array) -> tuple[Array, Array]:
    """Where a segment, center and half (3, P, B) in the axes of a box, touches it; size (3, P, 1), half of the box.

    Returns:
        The nearest point, and the far end of where it runs along a face, in [-1, 1] along ``half``, (P, B). The second
        may fall on the first, which C MuJoCo counts twice, too; ``_NONE`` where there is none.
    """
    best, first, second = _at_edges(center, half, size)
    for end in (-1.0, 1.0):
        distance, far = _at_end(end, center, half, size)
        better = distance <= best
        best = jnp.where(better, distance, best)
        first = jnp.where(better, end, first)
        second = jnp.where(better, far, second)
    return first, second


def _at_end(end: float, center: Array, half: Array, size: Array) -> tuple[Array, Array]:
    """Squared distance of one end if it lies over a face (else infinite), and where from there the face ends."""
    point = center + end * half
    beyond = jnp.maximum(jnp.abs(point) - size, 0.0)
    over = jnp.sum(beyond > 0, axis=0)
    reach = _share(size + jnp.sign(end * half) * point, half)  # until the slab of each axis is left
    reach = jnp.min(jnp.where(beyond > 0, 2.0, reach), axis=0)
    far = end - end * jnp.clip(reach, 0.0, 2.0)
    return jnp.where(over > 1, jnp.inf, _dot(beyond, beyond)), jnp.where(over == 0, _NONE, far)


def _at_edges(center: Array, half: Array, size: Array) -> tuple[Array, Array, Array]:
    """The edge nearest to a segment: squared distance, where on the segment, and the second point; (P, B) each."""
    # All twelve at once: (3 axes an edge can have, 4 edges along each, P, B). The coordinates are called j (along
    # the edge), a and b (across it), in cyclic order.
    sign_a, sign_b = (np.array(s)[None, :, None, None] for s in ((-1.0, -1.0, 1.0, 1.0), (-1.0, 1.0, -1.0, 1.0)))
    size_j, size_a, size_b = (_roll(jnp.broadcast_to(size, center.shape), k) for k in range(3))
    c_j, c_a, c_b = (_roll(center, k) for k in range(3))
    h_j, h_a, h_b = (_roll(half, k) for k in range(3))

    # Nearest points: y in [-1, 1] along the edge, s in [-1, 1] along the segment.
    d_a, d_b = c_a - sign_a * size_a, c_b - sign_b * size_b
    ee, es, ss = size_j * size_j, size_j * h_j, h_j * h_j + h_a * h_a + h_b * h_b
    ed, sd = size_j * c_j, h_j * c_j + h_a * d_a + h_b * d_b
    clipped = jnp.clip((ss * ed - es * sd) / jnp.maximum(ee * ss - es * es, _TINY), -1.0, 1.0)
    s = jnp.clip((es * clipped - sd) / jnp.maximum(ss, _TINY), -1.0, 1.0)
    y = jnp.clip((es * s + ed) / ee, -1.0, 1.0)
    # C MuJoCo takes the point for a corner if it was one before or after the segment's own end was respected.
    tip = jnp.where(jnp.abs(y) < 1, clipped, y)
    distance = (c_j + s * h_j - y * size_j) ** 2 + (d_a + s * h_a) ** 2 + (d_b + s * h_b) ** 2

    # How far the segment may run until it has crossed the box along each axis.
    width_j, width_a, width_b = _share(2 * size_j, h_j), _share(2 * size_a, h_a), _share(2 * size_b, h_b)
    in_a, in_b, in_j = h_a * sign_a < 0, h_b * sign_b < 0, h_j * tip < 0  # inwards with growing s?

    # Inside an edge: along the face to which the segment has the smaller angle.
    onto_b = jnp.abs(h_a) < jnp.abs(h_b)
    turn = jnp.where(jnp.where(onto_b, in_b, in_a), 1.0, -1.0)
    run = jnp.minimum(jnp.where(onto_b, width_b, width_a), _share(size_j * (1 - turn * jnp.sign(h_j) * y), h_j))
    edge = s + turn * jnp.minimum(run, 1 - turn * s)
    edge = jnp.where(in_a != in_b, edge, _NONE)

    # At a corner: one axis differs from the other two in whether the segment leads inwards. Along that axis' edge if
    # the segment mostly follows it, else over the face of the other two, the other way.
    odd_a, odd_b = (in_b == in_j) & (in_a != in_b), (in_a == in_j) & (in_a != in_b)
    odd_j = (in_a == in_b) & (in_a != in_j)

    def odd(a: Array, b: Array, j: Array) -> Array:
        return jnp.where(odd_a, a, jnp.where(odd_b, b, j))

    ahead = jnp.where(odd(in_a, in_b, in_j), 1.0, -1.0)
    h_odd, w_odd = odd(h_a, h_b, h_j), odd(width_a, width_b, width_j)
    w_rest = odd(jnp.minimum(width_b, width_j), jnp.minimum(width_a, width_j), jnp.minimum(width_a, width_b))
    follows = h_odd * h_odd > 0.5 * ss
    turn = jnp.where(follows, ahead, -ahead)
    corner = s + turn * jnp.minimum(jnp.where(follows, w_odd, w_rest), 1 - turn * s)
    corner = jnp.where(odd_a | odd_b | odd_j, corner, _NONE)

    second = jnp.where(jnp.abs(tip) < 1, edge, corner)
    best, first, far = distance[0, 0], s[0, 0], second[0, 0]
    for j, k in list(np.ndindex(3, 4))[1:]:
        better = distance[j, k] < best
        best = jnp.where(better, distance[j, k], best)
        first = jnp.where(better, s[j, k], first)
        far = jnp.where(better, second[j, k], far)
    return best, first, far


def _roll(x: Array, k: int) -> Array:
    """(3, P, B) to (3, 1, P, B), the axes turned cyclically by k."""
    return jnp.roll(x, -k, axis=0)[:, None]


def _share(distance: Array, half: Array) -> Array:
    """distance / |half|, huge where half is zero."""
    return distance / jnp.maximum(jnp.abs(half), _TINY)
