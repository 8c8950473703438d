"""Camera paths that nerfstudio's viewer saves (`ns-render camera-path` reads them, too)."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import CameraType
from torch import Tensor

from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.types import Camera


@dataclass(frozen=True)
class CameraPath:
    """Views in order."""

    cameras: list[Camera]
    fps: float
    """frames per second"""


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path, in the frame of the run that it was made with.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no camera path, has no views, or views that are no pinholes.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; save a camera path in the viewer's Render tab.")
    try:
        described: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        width, height = int(described["render_width"]), int(described["render_height"])
        views = described["camera_path"]
        # what divides by zero is refused below
        with np.errstate(all="ignore"):
            cameras = get_path_from_json(described) if views else None
        fps = float(described.get("fps", 24.0))
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
        raise ValueError(
            f"{path} is no camera path ({type(error).__name__}: {error}); save one in the viewer's Render tab."
        ) from error
    if cameras is None:
        raise ValueError(f"{path} has no views; add key frames in the viewer's Render tab.")
    if int(cameras.camera_type[0]) != CameraType.PERSPECTIVE.value:
        kind = described.get("camera_type")
        raise ValueError(f"{path} is of type '{kind}', and Gaussians are projected by pinholes; make it perspective.")
    if min(width, height) < 1 or not fps > 0:
        raise ValueError(f"{path} is {width}x{height} px at {fps} frames per second; each must be above 0.")
    for number, view in enumerate(views, start=1):
        _check_view(path, number, float(view["fov"]), cameras.camera_to_worlds[number - 1])
    drawn = [replace(to_camera(cameras[i : i + 1]), width=width, height=height) for i in range(len(views))]
    return CameraPath(drawn, fps)


def _check_view(path: Path, number: int, fov: float, pose: Float[Tensor, "3 4"]) -> None:
    """Before the first one is drawn."""
    if not 0 < fov < 180:
        raise ValueError(f"{path}: view {number} has a field of view of {fov:g} degrees; it must be between 0 and 180.")
    if not bool(torch.isfinite(pose).all()) or abs(float(torch.linalg.det(pose[:, :3]))) < 1e-6:
        raise ValueError(
            f"{path}: view {number} has no pose that a camera can have ({pose.tolist()}); save the path once more in "
            "the viewer's Render tab."
        )
