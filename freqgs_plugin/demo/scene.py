"""The demo scene: a room with a laid table. Sizes differ by a factor of 100, textures go from none to fine.

World: metres, z up, the table's centre above the origin. Everything follows from a seed, on any processor alike.
"""

import numpy as np
import torch
from jaxtyping import Float

from freqgs_plugin.demo.raytrace import Lamp, Solid, Surface, Triple, World
from freqgs_plugin.demo.textures import Number, Texture, checker, gradient, photo, solid, wood
from freqgs_plugin.demo.vectors import normalise, transform
from freqgs_plugin.types import Camera

TABLE_HEIGHT = 0.75
"""of the top, m"""
ROOM_HALF = 4.0
"""half of the room's width, m"""
ROOM_HEIGHT = 3.2
ZOOM_TARGET = "dice 1"
"""the solid that `zoom_path` looks at"""


def build_world(seed: int = 0) -> World:
    """Room, furniture, pictures and what lies on the table."""
    solids = (_room(seed), *_furniture(seed), *_pictures(), *_large_things(), *_small_things(seed))
    return World(solids, Lamp((0.6, -0.8, ROOM_HEIGHT - 0.01), 1.0))


def _plain(texture: Texture, *tiles: Number) -> tuple[Surface, ...]:
    return (Surface(texture, (tiles[0], tiles[1]) if tiles else (1.0, 1.0)),)


def _room(seed: int) -> Solid:
    walls = [
        gradient((0.93, 0.87, 0.74), (0.83, 0.73, 0.58)),
        gradient((0.52, 0.68, 0.70), (0.36, 0.53, 0.58)),
        gradient((0.86, 0.70, 0.64), (0.76, 0.55, 0.50)),
        gradient((0.80, 0.84, 0.76), (0.64, 0.71, 0.60)),
        solid(0.95, 0.95, 0.93),
    ]
    floor = Surface(wood(seed + 1), (4, 4))
    faces = (*(Surface(w) for w in walls), floor)
    return Solid("room", "room", (0, 0, ROOM_HEIGHT / 2), (ROOM_HALF, ROOM_HALF, ROOM_HEIGHT / 2), faces)


def _furniture(seed: int) -> list[Solid]:
    cloth = Surface(checker((0.93, 0.90, 0.84), (0.55, 0.66, 0.74), 2, 2), (14, 14))
    edge = Surface(solid(0.42, 0.29, 0.19))
    rug = Surface(photo("grass", (1.35, 0.72, 0.62), repeat=True), (3, 3))
    bricks = Surface(photo("brick", (1.5, 0.95, 0.75), repeat=True), (3, 1))
    return [
        Solid("rug", "cylinder", (0, 0, 0.01), (2.0, 2.0, 0.01), (rug,)),
        Solid("table", "cylinder", (0, 0, TABLE_HEIGHT - 0.02), (1.1, 1.1, 0.02), (edge, cloth), specular=0.05),
        Solid("table leg", "cylinder", (0, 0, 0.36), (0.12, 0.12, 0.35), (edge,)),
        Solid("planter", "cylinder", (-2.9, 2.8, 0.35), (0.45, 0.45, 0.35), (bricks, Surface(photo("gravel")))),
        Solid(
            "bush",
            "sphere",
            (-2.9, 2.8, 1.15),
            (0.62, 0.62, 0.6),
            _plain(photo("grass", (0.8, 1.35, 0.6), repeat=True), 3, 1.5),
        ),
        Solid("stool", "box", (2.7, 2.6, 0.3), (0.4, 0.4, 0.3), _plain(solid(0.85, 0.62, 0.25)), yaw=25, specular=0.1),
        Solid("column", "cylinder", (3.0, -2.9, 1.6), (0.3, 0.3, 1.6), _plain(solid(0.82, 0.82, 0.86)), specular=0.1),
    ]


def _pictures() -> list[Solid]:
    frame = Surface(solid(0.25, 0.18, 0.12))

    def picture(name: str, centre: Triple, width: Number, height: Number) -> list[Solid]:
        axis = int(np.argmax(np.abs(centre[:2])))
        half = [width / 2, width / 2, height / 2]
        half[axis] = 0.03
        rim = tuple(h + 0.06 if i != axis else 0.02 for i, h in enumerate(half))
        texture = Surface(photo(name))
        return [
            Solid(f"frame of {name}", "box", centre, (rim[0], rim[1], rim[2]), (frame,)),
            Solid(f"picture {name}", "box", centre, (half[0], half[1], half[2]), (texture,)),
        ]

    wall = ROOM_HALF - 0.02
    return [
        *picture("rocket", (wall, 0.4, 1.7), 1.8, 1.2),
        *picture("hubble_deep_field", (-wall, -0.6, 1.75), 1.7, 1.45),
        *picture("chelsea", (0.5, wall, 1.7), 1.8, 1.2),
        *picture("coffee", (-0.7, -wall, 1.65), 1.65, 1.1),
    ]


def _large_things() -> list[Solid]:
    """Decimetres: low and middle frequencies."""
    z = TABLE_HEIGHT
    astronaut, moon = _plain(photo("astronaut")), _plain(photo("moon", (1.6, 1.5, 1.25)))
    pot = (Surface(photo("brick", (0.8, 1.25, 1.35), repeat=True), (3, 1.5)), Surface(photo("gravel")))
    book = (Surface(solid(0.93, 0.91, 0.86)),) * 4 + (Surface(photo("page")), Surface(solid(0.3, 0.2, 0.5)))
    tissue = _plain(photo("immunohistochemistry"))
    return [
        Solid("red ball", "sphere", (-0.38, 0.30, z + 0.26), (0.26, 0.26, 0.26), _plain(solid(0.80, 0.16, 0.14)),
              specular=0.35, shininess=60),
        Solid("astronaut box", "box", (0.35, 0.42, z + 0.21), (0.2, 0.2, 0.21), astronaut, yaw=28, specular=0.05),
        Solid("brick pot", "cylinder", (-0.12, -0.28, z + 0.19), (0.12, 0.12, 0.19), pot),
        Solid("moon", "sphere", (0.38, -0.22, z + 0.15), (0.15, 0.15, 0.15), moon, yaw=70),
        Solid("tissue box", "box", (-0.58, -0.32, z + 0.10), (0.1, 0.1, 0.1), tissue, yaw=-20),
        Solid("book", "box", (0.72, 0.02, z + 0.02), (0.19, 0.13, 0.02), book, yaw=70),
        Solid("blue pillar", "cylinder", (-0.82, 0.02, z + 0.15), (0.05, 0.05, 0.15), _plain(solid(0.2, 0.36, 0.7)),
              specular=0.3),
    ]  # fmt: skip


def _small_things(seed: int) -> list[Solid]:
    """Centimetres, finely textured: dice, marbles and pencils towards the table's near side."""
    rng = np.random.default_rng(seed)
    z = TABLE_HEIGHT
    dice = [
        Solid(f"dice {i + 1}", "box", (0.24 + 0.11 * i, -0.62 + 0.05 * i, z + half), (half, half, half),
              _plain(texture), yaw=float(rng.uniform(0, 90)))
        for i, (half, texture) in enumerate(
            [
                (0.035, photo("coins", (1.5, 1.25, 0.7))),
                (0.030, checker((0.95, 0.95, 0.9), (0.1, 0.1, 0.12), 6, 6)),
                (0.025, photo("astronaut", crop=(0, 256, 100, 356))),
            ]
        )
    ]  # fmt: skip
    colours = [(0.95, 0.75, 0.1), (0.1, 0.6, 0.3), (0.75, 0.2, 0.6), (0.1, 0.5, 0.8), (0.95, 0.45, 0.1)]
    marbles = [
        Solid(f"marble {i + 1}", "sphere", (-0.42 + 0.085 * i, -0.68 + 0.04 * np.sin(2.0 * i), z + 0.024),
              (0.024, 0.024, 0.024), _plain(checker(colour, (0.97, 0.95, 0.9), 6, 4)), specular=0.4,
              yaw=float(rng.uniform(0, 360)))
        for i, colour in enumerate(colours)
    ]  # fmt: skip
    pencils = [
        Solid(f"pencil {i + 1}", "cylinder", (-0.12 + dx, -0.28 + dy, z + 0.42), (0.009, 0.009, 0.16),
              _plain(solid(*c)), yaw=yaw, tilt=12)
        for i, (dx, dy, yaw, c) in enumerate(
            [(0.04, 0.02, 20, colours[0]), (-0.03, 0.04, 150, colours[2]), (0.0, -0.05, 265, colours[3])]
        )
    ]  # fmt: skip
    return [*dice, *marbles, *pencils]


def look_at(
    eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], width: int, height: int, fov: Number = 58.0
) -> Camera:
    """A camera at `eye` that sees `target` in its middle, world z up; `fov` is the horizontal angle in degrees."""
    forward = normalise(target - eye)
    right = normalise(np.cross(forward, (0.0, 0.0, 1.0)))
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -transform(rotation, eye)
    focal = width / 2 / np.tan(np.radians(fov) / 2)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(intrinsics).float(), width, height)


def orbit(count: int = 36, width: int = 320, height: int = 240, seed: int = 0) -> list[Camera]:
    """Cameras around the table, 1.3 to 3.4 m from its axis and 1.0 to 2.5 m high, in order of azimuth."""
    rng = np.random.default_rng(seed + 100)
    phase = rng.uniform(0, 2 * np.pi, 3)
    azimuth = 2 * np.pi * np.arange(count) / count
    distance = 2.35 + 1.05 * np.sin(5 * azimuth + phase[0])
    altitude = 1.75 + 0.7 * np.sin(7 * azimuth + phase[1])
    cameras = []
    for a, d, z in zip(azimuth, distance, altitude, strict=True):
        eye = np.array([d * np.cos(a), d * np.sin(a), z])
        target = np.array([0.0, 0.0, TABLE_HEIGHT + 0.12]) + rng.uniform(-0.12, 0.12, 3)
        cameras.append(look_at(eye, target, width, height))
    return cameras


def zoom_path(
    world: World, count: int = 48, width: int = 320, height: int = 240, near: Number = 0.3, far: Number = 3.1
) -> list[Camera]:
    """Cameras on a straight line away from the dice, `near` to `far` metres from the first, geometrically spaced.

    The line stays among the cameras of `orbit`, where trained scenes are clear: beyond, it would enter the wall.
    """
    item = next(s for s in world.solids if s.name == ZOOM_TARGET)
    target = np.array(item.centre)
    direction = normalise(np.array([0.60, -0.80, 0.42]))
    return [look_at(target + d * direction, target, width, height) for d in np.geomspace(near, far, count)]
