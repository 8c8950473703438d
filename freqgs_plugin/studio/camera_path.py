"""Camera paths that nerfstudio's viewer saves (`ns-render camera-path` reads them, too)."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import CameraType

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
        cameras = get_path_from_json(described) if views else None
        fps = float(described.get("fps", 24.0))
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
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
    drawn = [replace(to_camera(cameras[i : i + 1]), width=width, height=height) for i in range(len(views))]
    return CameraPath(drawn, fps)
