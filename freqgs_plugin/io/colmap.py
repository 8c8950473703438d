"""COLMAP models through pycolmap: the sparse/0 folder that nerfstudio's `colmap` dataparser reads."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from freqgs_plugin.types import Camera

if TYPE_CHECKING:
    from pycolmap import Reconstruction


@dataclass(frozen=True)
class Points:
    """Sparse points, with the places where views saw them. Row i of the last three belongs together."""

    xyz: Float[np.ndarray, "n 3"]
    """world"""
    rgb: UInt8[np.ndarray, "n 3"]
    point: Int[np.ndarray, " m"]
    """of each observation: which point, 0..n-1"""
    view: Int[np.ndarray, " m"]
    """of each observation: which view, in the order of the cameras"""
    xy: Float[np.ndarray, "m 2"]
    """of each observation: where in that view, pixels, the centre of the first pixel at (0.5, 0.5)"""


def write_colmap(folder: Path, cameras: list[Camera], names: list[str], points: Points) -> None:
    """Write cameras.bin, images.bin and points3D.bin (and what else pycolmap's version writes) into `folder`.

    Views with equal intrinsics and size share one PINHOLE camera. Image ids follow the order of `cameras`, so that
    nerfstudio's interval split takes every eighth of them.

    Raises:
        ValueError: not one name per camera, or a name twice.
    """
    if len(names) != len(cameras) or len(set(names)) != len(names):
        raise ValueError(f"{len(cameras)} cameras need as many different names, not {len(names)}: {names[:3]} ...")
    import pycolmap

    model = pycolmap.Reconstruction()
    sensors: dict[tuple[float | int, ...], int] = {}
    slots = np.zeros(len(points.point), dtype=np.int64)
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        rows = np.flatnonzero(points.view == i)
        slots[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=name,
            keypoints=points.xy[rows].astype(np.float64),
            camera_id=_sensor(model, sensors, camera),
            image_id=i + 1,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.viewmat[:3].cpu().double().numpy()))
    order = np.argsort(points.point, kind="stable")
    starts = np.searchsorted(points.point[order], np.arange(len(points.xyz) + 1))
    for i, (xyz, rgb) in enumerate(zip(points.xyz.astype(np.float64), points.rgb, strict=True)):
        track = pycolmap.Track()
        for row in order[starts[i] : starts[i + 1]]:
            track.add_element(int(points.view[row]) + 1, int(slots[row]))
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))


def check_lengths(folder: Path) -> None:
    """Walk through the records of images.bin and points3D.bin without reading them.

    pycolmap does not notice the end of a truncated file: it may ask for as much memory as a random number says.

    Raises:
        ValueError: a file is shorter or longer than its records; the message names it.
    """
    for name, fixed, named, element in (("images.bin", 64, True, 24), ("points3D.bin", 43, False, 8)):
        content = (folder / name).read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", content)
            position = 8
            for _ in range(count):
                position += fixed
                if named:
                    position = content.index(b"\0", position) + 1
                position += 8 + element * struct.unpack_from("<Q", content, position)[0]
        except (struct.error, ValueError) as error:
            raise ValueError(f"{folder / name} ends too early") from error
        if position != len(content):
            raise ValueError(f"{folder / name} has {len(content)} bytes in place of {position}")


def _sensor(model: "Reconstruction", sensors: dict[tuple[float | int, ...], int], camera: Camera) -> int:
    """Id of the PINHOLE camera with these intrinsics, added to the model where it is new."""
    import pycolmap

    matrix = camera.K.cpu().double()
    intrinsics = (float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]))
    key = (camera.width, camera.height, *intrinsics)
    if key not in sensors:
        sensors[key] = len(sensors) + 1
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=sensors[key],
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=list(intrinsics),
            )
        )
    return sensors[key]
