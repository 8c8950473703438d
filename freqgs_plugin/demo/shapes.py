"""Ray intersections of unit solids, with normals and texture coordinates.

A solid is a unit shape scaled by half-extents, turned and moved: the cube [-1, 1]^3, the unit sphere, or the cylinder
of radius 1 with |z| <= 1. Rays enter in unit coordinates, with directions scaled alike, so that `t` keeps its world
meaning.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from freqgs_plugin.demo.vectors import dot

Vectors = Float[np.ndarray, "n 3"]
Distances = Float[np.ndarray, " n"]
Kind = Literal["room", "box", "sphere", "cylinder"]

_Z = np.array((0, 0, 1), np.float32)
EPSILON = 1e-4
"""hits nearer than this along the ray are ignored"""


@dataclass(frozen=True)
class Hits:
    """Surface properties at hit points, in unit coordinates."""

    normal: Vectors
    """outward, any length"""
    uv: Float[np.ndarray, "n 2"]
    """texture coordinates, u right, v down, [0, 1]"""
    face: Int[np.ndarray, " n"]
    """box: +x -x +y -y +z -z as 0..5; cylinder: side 0, caps 1; sphere: 0"""


def _slabs(origin: Float[np.ndarray, " 3"], direction: Vectors) -> tuple[Distances, Distances]:
    inverse = 1 / np.where(np.abs(direction) < 1e-12, np.float32(1e-12), direction)
    first, second = (-1 - origin) * inverse, (1 - origin) * inverse
    return np.minimum(first, second).max(1), np.maximum(first, second).min(1)


def _box(origin: Float[np.ndarray, " 3"], direction: Vectors) -> Distances:
    near, far = _slabs(origin, direction)
    return np.where((near <= far) & (near > EPSILON), near, np.inf)


def _room(origin: Float[np.ndarray, " 3"], direction: Vectors) -> Distances:
    """A box seen from inside."""
    return _slabs(origin, direction)[1]


def _quadratic(a: Distances, half_b: Distances, c: float) -> tuple[Distances, Distances]:
    """Roots of a t^2 + 2 half_b t + c, infinite where there are none."""
    discriminant = half_b * half_b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    a = np.maximum(a, 1e-12)
    miss = discriminant < 0
    return np.where(miss, np.inf, (-half_b - root) / a), np.where(miss, -np.inf, (-half_b + root) / a)


def _sphere(origin: Float[np.ndarray, " 3"], direction: Vectors) -> Distances:
    near, _ = _quadratic(dot(direction, direction), dot(direction, origin), float(dot(origin, origin)) - 1)
    return np.where(near > EPSILON, near, np.inf)


def _cylinder(origin: Float[np.ndarray, " 3"], direction: Vectors) -> Distances:
    """The intersection of the infinite cylinder's interval with that of the slab |z| <= 1."""
    xy, start = direction[:, :2], origin[:2]
    near, far = _quadratic(dot(xy, xy), dot(xy, start), float(dot(start, start)) - 1)
    inverse = 1 / np.where(np.abs(direction[:, 2]) < 1e-12, np.float32(1e-12), direction[:, 2])
    first, second = (-1 - origin[2]) * inverse, (1 - origin[2]) * inverse
    near = np.maximum(near, np.minimum(first, second))
    far = np.minimum(far, np.maximum(first, second))
    return np.where((near <= far) & (near > EPSILON), near, np.inf)


_INTERSECT: dict[Kind, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "room": _room,
    "box": _box,
    "sphere": _sphere,
    "cylinder": _cylinder,
}


def intersect(kind: Kind, origin: Float[np.ndarray, " 3"], direction: Vectors) -> Distances:
    """The smallest t > 0 with origin + t direction on the surface, infinite where the ray misses."""
    return _INTERSECT[kind](origin, direction)


def _cube_surface(point: Vectors) -> Hits:
    axis = np.abs(point).argmax(1)
    rows = np.arange(len(point))
    sign = np.sign(point[rows, axis])
    normal = np.zeros_like(point)
    normal[rows, axis] = sign
    x, y, z = point.T
    u = np.choose(axis, [y * sign, -x * sign, x])
    v = np.choose(axis, [-z, -z, -y * sign])
    return Hits(normal, np.stack([u + 1, v + 1], 1) / 2, axis * 2 + (sign < 0))


def _sphere_surface(point: Vectors) -> Hits:
    u = np.arctan2(point[:, 1], point[:, 0]) / np.float32(2 * np.pi) + np.float32(0.5)
    v = np.arccos(np.clip(point[:, 2], -1, 1)) / np.float32(np.pi)
    return Hits(point, np.stack([u, v], 1), np.zeros(len(point), dtype=np.int64))


def _cylinder_surface(point: Vectors) -> Hits:
    x, y, z = point.T
    cap = np.abs(z) > x * x + y * y
    normal = np.where(cap[:, None], point * _Z, point * (1 - _Z))
    u = np.where(cap, (x + 1) / 2, np.arctan2(y, x) / np.float32(2 * np.pi) + np.float32(0.5))
    v = np.where(cap, (1 - y) / 2, (1 - z) / 2)
    return Hits(normal, np.stack([u, v], 1), cap.astype(np.int64))


_SURFACE: dict[Kind, Callable[[np.ndarray], Hits]] = {
    "room": _cube_surface,
    "box": _cube_surface,
    "sphere": _sphere_surface,
    "cylinder": _cylinder_surface,
}


def surface(kind: Kind, point: Vectors) -> Hits:
    """Normals, texture coordinates and faces at points on the unit surface. A room's normals also point outwards."""
    return _SURFACE[kind](point)


def face_size(kind: Kind, half: Float[np.ndarray, " 3"]) -> list[tuple[float, float]]:
    """Extent of u and v in the world for each face of a solid with half-extents `half`, world units."""
    x, y, z = (2 * float(h) for h in half)
    match kind:
        case "sphere":
            return [(np.pi * x, np.pi * z / 2)]
        case "cylinder":
            return [(np.pi * x, z), (x, y)]
        case _:
            return [(y, z), (y, z), (x, z), (x, z), (x, y), (x, y)]
