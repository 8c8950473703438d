"""Masks of an object in photographs: from a folder, and whether they fit the views."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from freqgs_plugin.types import Camera

SUFFIX = ".png"
"""lossless: next to an edge, a JPEG has values that nobody drew"""


class MaskError(ValueError):
    """Masks that mark no object in these views; the message holds the remedy."""


def read_masks(folder: Path, names: Sequence[str], cameras: Sequence[Camera]) -> dict[int, Bool[Tensor, "_ _"]]:
    """The masks in `folder` by the index of their view; what is not 0 is the object.

    `view.png` and `view.jpg.png` are masks of the view `view.jpg`. Of masks with colours, one colour that is not 0 is
    enough; an alpha channel hides what it makes transparent. Views without a mask are left out, and masks without a
    view are ignored. A mask that is empty counts: the object is not seen there.

    Args:
        folder: with PNG files.
        names: of the views, for example `view_000.png`.
        cameras: of the views, in the same order.

    Raises:
        MaskError: no such folder, no mask of any view, one that cannot be read or is of another size than its view,
            or nothing in any of them.
    """
    files = _mask_files(folder)
    found: dict[int, Path] = {}
    for index, name in enumerate(names):
        for key in (name, Path(name).stem):
            if key in files:
                found[index] = files[key]
                break
    if not found:
        raise MaskError(
            f"none of the {len(files)} masks in {folder} is called like a view: masks are {_some(list(files))}, views "
            f"{_some([Path(name).stem for name in names])}. Give a mask its view's name, with the ending {SUFFIX}."
        )
    masks = {index: _read(path, cameras[index]) for index, path in found.items()}
    if not any(bool(mask.any()) for mask in masks.values()):
        raise MaskError(f"all {len(masks)} masks in {folder} are empty; the object's pixels must not be 0.")
    return masks


def check_masks(cameras: Sequence[Camera], masks: Sequence[Bool[Tensor, "_ _"]]) -> None:
    """Refuse masks that do not fit the views, and masks of nothing.

    Raises:
        MaskError: with what is wrong and the remedy.
    """
    if not cameras or len(cameras) != len(masks):
        raise MaskError(f"{len(masks)} masks for {len(cameras)} views; give one or more views, and a mask for each.")
    for i, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        check_size(f"mask {i}", mask.shape[1], mask.shape[0], camera)
    if not any(bool(mask.any()) for mask in masks):
        which = f"all of the {len(masks)} masks are" if len(masks) > 1 else "the mask is"
        raise MaskError(f"{which} empty; mark the object in at least one view.")


def check_size(what: str, width: int, height: int, camera: Camera) -> None:
    """Refuse what is of another size than its view, with a MaskError."""
    if (width, height) != (camera.width, camera.height):
        raise MaskError(
            f"{what} is {width}x{height} px, and its view {camera.width}x{camera.height} px; bring one to the size of "
            "the other."
        )


def _mask_files(folder: Path) -> dict[str, Path]:
    """Name without the ending -> file.

    Raises:
        MaskError: no such folder, or no PNG file in it.
    """
    if not folder.is_dir():
        raise MaskError(f"{folder} is no folder; name the one that holds the masks, one {SUFFIX} for each view.")
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() == SUFFIX}
    if not files:
        raise MaskError(f"{folder} holds no {SUFFIX} file; masks are images of that kind, named like their views.")
    return files


def _read(path: Path, camera: Camera) -> Bool[Tensor, "_ _"]:
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise MaskError(f"mask {path} cannot be read: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    if image is None:
        raise MaskError(f"mask {path} cannot be decoded; it is damaged or no PNG file. Export it again.")
    check_size(f"mask {path}", image.shape[1], image.shape[0], camera)
    if image.ndim == 2:
        return torch.from_numpy(image != 0)
    object_ = (image[..., :3] != 0).any(-1)
    return torch.from_numpy(object_ & (image[..., 3] != 0) if image.shape[2] == 4 else object_)


def _some(names: list[str]) -> str:
    return ", ".join(sorted(names)[:3]) + (" ..." if len(names) > 3 else "")
