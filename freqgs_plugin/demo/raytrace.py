"""A small ray tracer in numpy: the demo's ground truth, which owes nothing to a rasterizer.

Diffuse shading with a hemisphere of ambient light, soft shadows from a square ceiling lamp, a slight view-dependent
highlight, and one ray per point of an n x n grid in each pixel. Sub-sample i also uses the i-th point of the lamp, so
that shadows are soft without noise. Colours are display-referred: there is no gamma, and sub-samples are averaged as
shown.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from freqgs_plugin.demo.shapes import Kind, face_size, intersect, surface
from freqgs_plugin.demo.textures import Number, Texture
from freqgs_plugin.demo.vectors import dot, length, normalise, transform
from freqgs_plugin.types import Camera

Vectors = Float[np.ndarray, "n 3"]
Triple = tuple[Number, Number, Number]

AMBIENT = 0.52
DIFFUSE = 0.6
SHADOW_MARGIN = 2e-3
"""share of the way to the lamp next to the surface in which occluders are ignored"""


@dataclass(frozen=True)
class Surface:
    """How one face of a solid looks."""

    texture: Texture
    tiles: tuple[Number, Number] = (1.0, 1.0)
    """repetitions along u and v"""


@dataclass(frozen=True)
class Solid:
    """A scaled, turned and moved unit shape."""

    name: str
    kind: Kind
    centre: Triple
    """world"""
    half: Triple
    """half-extents along its own axes (a sphere's and a cylinder's radius), world units"""
    faces: tuple[Surface, ...]
    """in the order of `shapes.Hits.face`; the last one serves all faces beyond"""
    yaw: Number = 0.0
    """rotation about world z, degrees"""
    tilt: Number = 0.0
    """rotation about its own x before the yaw, degrees"""
    specular: Number = 0.0
    """strength of the highlight, [0, 1]"""
    shininess: Number = 40.0
    """exponent of the highlight"""

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Own axes to world."""
        (cz, sz), (cx, sx) = ((np.cos(np.radians(a)), np.sin(np.radians(a))) for a in (self.yaw, self.tilt))
        return np.array([[cz, -sz * cx, sz * sx], [sz, cz * cx, -cz * sx], [0, sx, cx]]).astype(np.float32)

    @property
    def bound(self) -> float:
        """Radius of a sphere around the centre that holds the solid, world units."""
        x, y, z = self.half
        corner = {"sphere": max(x, y, z), "cylinder": float(np.hypot(max(x, y), z))}
        return corner.get(self.kind, float(length(np.array(self.half, np.float64))))

    @property
    def position(self) -> Float[np.ndarray, " 3"]:
        """The centre as an array."""
        return np.array(self.centre, np.float32)

    @property
    def extent(self) -> Float[np.ndarray, " 3"]:
        """The half-extents as an array."""
        return np.array(self.half, np.float32)

    def to_unit(self, vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """World vectors (not points) in unit coordinates."""
        return transform(self.rotation.T, vectors) / self.extent


@dataclass(frozen=True)
class Lamp:
    """A square lamp that faces down; light does not fall off with distance."""

    centre: Triple
    side: Number
    """world units"""

    def point(self, index: int, samples: int) -> Float[np.ndarray, " 3"]:
        """Centre of field `index` of a samples x samples grid, taken in an order unlike that of the pixel grid."""
        row, column = divmod((index * 5 + 2) % samples**2 if samples > 1 else 0, samples)
        offset = (np.array([column, row, 0]) + 0.5) / samples - 0.5
        return (np.array(self.centre) + offset * (self.side, self.side, 0)).astype(np.float32)


@dataclass(frozen=True)
class World:
    """What there is to see. The first solid is the room."""

    solids: tuple[Solid, ...]
    lamp: Lamp


def unproject(
    intrinsics: Float[np.ndarray, "3 3"], x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Points of camera z 1 that are seen at the pixel positions (x, y); camera axes. Skew is taken to be 0."""
    (fx, _, cx), (_, fy, cy) = intrinsics[:2]
    return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], 1)


def pixel_rays(camera: Camera, dx: Number = 0.5, dy: Number = 0.5) -> tuple[Float[np.ndarray, " 3"], Vectors]:
    """Camera centre, and unit directions through the points (x + dx, y + dy) of all pixels, row by row; world."""
    intrinsics, viewmat = camera.K.cpu().double().numpy(), camera.viewmat.cpu().double().numpy()
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    directions = normalise(transform(viewmat[:3, :3].T, unproject(intrinsics, x.ravel() + dx, y.ravel() + dy)))
    return camera.centre.cpu().numpy().astype(np.float32), directions.astype(np.float32)


def cast(
    solids: tuple[Solid, ...], origin: Float[np.ndarray, " 3"], directions: Vectors
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """First hits of rays from one point.

    Args:
        solids: what may be hit.
        origin: where all rays start, world.
        directions: unit vectors.

    Returns:
        distance (infinite where nothing is hit) and index of the solid (-1).
    """
    nearest = np.full(len(directions), np.inf, dtype=np.float32)
    index = np.full(len(directions), -1, dtype=np.int64)
    for i, item in enumerate(solids):
        rows = _candidates(item, origin, directions)
        if rows is not None and len(rows) == 0:
            continue
        some = directions if rows is None else directions[rows]
        rows = slice(None) if rows is None else rows
        t = intersect(item.kind, item.to_unit(origin - item.position), item.to_unit(some))
        closer = t < nearest[rows]
        nearest[rows] = np.where(closer, t, nearest[rows])
        index[rows] = np.where(closer, i, index[rows])
    return nearest, index


def _candidates(item: Solid, origin: Float[np.ndarray, " 3"], directions: Vectors) -> Int[np.ndarray, " m"] | None:
    """Rays inside of the cone around the solid's bounding sphere; None means all."""
    offset = item.position - origin
    distance = float(length(offset))
    if item.kind == "room" or distance <= item.bound:
        return None
    cosine = np.sqrt(1 - (item.bound / distance) ** 2)
    return np.flatnonzero(dot(directions, offset / distance) >= cosine - 1e-6)


def _shade(
    world: World, camera: Camera, origin: Float[np.ndarray, " 3"], directions: Vectors, lamp: Float[np.ndarray, " 3"],
    spacing: float,
) -> Vectors:  # fmt: skip
    """Colours seen along rays. `spacing` is the angle between neighbouring rays in radians."""
    distance, index = cast(world.solids, origin, directions)
    points = origin + distance[:, None] * directions
    to_lamp = lamp - points
    lamp_distance = length(to_lamp)
    to_lamp /= lamp_distance[:, None]
    blocked = cast(world.solids[1:], lamp, -to_lamp)[0] < lamp_distance * np.float32(1 - SHADOW_MARGIN)
    colours = np.zeros_like(directions)
    for i in np.unique(index):
        rows = np.flatnonzero(index == i)
        albedo, normal = _material(world.solids[i], points[rows], directions[rows], distance[rows] * spacing)
        lit = ~blocked[rows]
        facing = np.maximum(dot(normal, to_lamp[rows]), 0) * lit
        ambient = AMBIENT * (0.85 + 0.15 * normal[:, 2])
        half = normalise(to_lamp[rows] - directions[rows])
        item = world.solids[i]
        highlight = item.specular * lit * np.maximum(dot(normal, half), 0) ** item.shininess
        colours[rows] = albedo * (ambient + DIFFUSE * facing)[:, None] + highlight[:, None]
    return colours


def _material(
    item: Solid, points: Vectors, directions: Vectors, footprint: Float[np.ndarray, " n"]
) -> tuple[Vectors, Vectors]:
    """Albedo and unit normal (towards the viewer). `footprint`: distance between neighbouring rays, world."""
    hits = surface(item.kind, item.to_unit(points - item.position))
    normal = normalise(transform(item.rotation, hits.normal / item.extent))
    cosine = -dot(normal, directions)
    normal = np.where(cosine[:, None] < 0, -normal, normal)
    sizes = face_size(item.kind, item.extent)
    albedo = np.empty_like(points)
    for face in np.unique(hits.face):
        rows = np.flatnonzero(hits.face == face)
        look = item.faces[min(int(face), len(item.faces) - 1)]
        height, width = look.texture.image.shape[:2]
        (u, v), (tu, tv) = sizes[face], look.tiles
        density = np.sqrt(width * tu / u * height * tv / v)
        texels = footprint[rows] * np.float32(density) / np.sqrt(np.maximum(np.abs(cosine[rows]), 0.05))
        albedo[rows] = look.texture.sample(hits.uv[rows] * np.array(look.tiles, np.float32), texels)
    return albedo, normal


def render_truth(world: World, camera: Camera, samples: int = 3) -> Float[np.ndarray, "h w 3"]:
    """The picture, RGB in [0, 1], from samples x samples rays per pixel."""
    total = np.zeros((camera.height * camera.width, 3), dtype=np.float32)
    spacing = 1 / (float(camera.K[0, 0]) * samples)
    for i in range(samples**2):
        dy, dx = ((k + 0.5) / samples for k in divmod(i, samples))
        origin, directions = pixel_rays(camera, dx, dy)
        colours = _shade(world, camera, origin, directions, world.lamp.point(i, samples), spacing)
        total += np.clip(colours, 0, 1)
    return (total / samples**2).reshape(camera.height, camera.width, 3)


def object_ids(world: World, camera: Camera) -> Int[np.ndarray, "h w"]:
    """Index into `world.solids` of what the ray through each pixel's centre hits; 0 is the room."""
    return cast(world.solids, *pixel_rays(camera))[1].reshape(camera.height, camera.width)


def depth_map(world: World, camera: Camera) -> Float[np.ndarray, "h w"]:
    """Camera z of what the ray through each pixel's centre hits, world units."""
    origin, directions = pixel_rays(camera)
    distance, _ = cast(world.solids, origin, directions)
    z = dot(directions, camera.viewmat[2, :3].cpu().numpy().astype(np.float32))
    return (distance * z).reshape(camera.height, camera.width)
