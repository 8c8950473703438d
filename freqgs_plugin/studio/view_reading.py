"""One photograph as nerfstudio's full-image datamanager caches it, what it depends on, and how much it takes."""

from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from PIL import Image

from freqgs_plugin.io.check_images import SceneError

ImageType = Literal["uint8", "float32"]
NEW_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")
"""what undistortion changes of a camera; pixels"""
_SOFTWARE = {name: version(name) for name in ("nerfstudio", "pillow", "numpy")}


def read_view(
    dataset: Any, cameras: Cameras, index: int, image_type: ImageType
) -> tuple[dict[str, Any], dict[str, float] | None]:
    """A view as nerfstudio's `_load_images` lists it, and its new camera (`NEW_CAMERA`), if it was undistorted.

    nerfstudio's own lines for this are inside a function that keeps all views.

    Args:
        cameras: as they were before any undistortion.
    """
    data, camera = dataset.get_data(index, image_type=image_type), cameras[index].reshape(())
    height, width = data["image"].shape[:2]
    expected = int(camera.width.item()), int(camera.height.item())
    if (width, height) != expected:
        raise SceneError(
            f"image {dataset.image_filenames[index]} is {width}x{height}, but its camera is "
            f"{expected[0]}x{expected[1]}. Use the images that the cameras were made for."
        )
    if camera.distortion_params is None or bool((camera.distortion_params == 0).all()):
        return data, None
    distortion, K = camera.distortion_params.numpy(), camera.get_intrinsics_matrices().numpy()
    K, image, mask = _undistort_image(camera, distortion, data, data["image"].numpy(), K)
    data["image"] = torch.from_numpy(image)
    if mask is not None:
        data["mask"] = mask
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], image.shape[1], image.shape[0])
    return data, dict(zip(NEW_CAMERA, map(float, values), strict=True))


def view_settings(dataset: Any, cameras: Cameras, index: int, image_type: ImageType) -> dict[str, Any]:
    """All that `read_view` depends on, as JSON: files with sizes and times, camera, and how they are read."""
    import cv2

    outputs = dataset._dataparser_outputs
    distortion = cameras.distortion_params
    return {
        "sources": [file_state(path) for path in _sources(dataset, index)],
        "camera": {name: getattr(cameras, name)[index].item() for name in (*NEW_CAMERA, "camera_type")},
        "distortion": None if distortion is None else distortion[index].tolist(),
        "scale_factor": dataset.scale_factor,
        "alpha_color": None if outputs.alpha_color is None else outputs.alpha_color.tolist(),
        "mask_color": None if dataset.mask_color is None else list(dataset.mask_color),
        "image_type": image_type,
        "software": {**_SOFTWARE, "opencv": cv2.__version__},
    }


def file_state(path: Path) -> list[Any]:
    """Full name, size in bytes and time of the last change in nanoseconds."""
    state = path.stat()
    return [str(path.resolve()), state.st_size, state.st_mtime_ns]


def view_bytes(dataset: Any, cameras: Cameras, index: int, image_type: ImageType) -> int:
    """Bytes of a view's image and mask; images whose transparency is kept have four channels."""
    with Image.open(dataset.image_filenames[index]) as image:
        transparent = image.mode == "RGBA" and dataset._dataparser_outputs.alpha_color is None
    per_pixel = (4 if transparent else 3) * (4 if image_type == "float32" else 1)
    per_pixel += dataset._dataparser_outputs.mask_filenames is not None
    return int(cameras.width[index].item()) * int(cameras.height[index].item()) * per_pixel


def _sources(dataset: Any, index: int) -> list[Path]:
    masks = dataset._dataparser_outputs.mask_filenames
    return [Path(dataset.image_filenames[index]), *([] if masks is None else [Path(masks[index])])]
