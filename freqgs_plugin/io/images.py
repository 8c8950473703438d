"""Image files through OpenCV. Everywhere else colours are RGB; BGR exists only in this file."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

FORMATS = (".png", ".jpg", ".jpeg")


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit colour image as RGB; an alpha channel is dropped.

    Raises:
        ValueError: the file is missing, empty, no image, grey or deeper than 8 bits; the message names it.
    """
    if not path.is_file():
        raise ValueError(f"image {path} does not exist")
    if path.stat().st_size == 0:
        raise ValueError(f"image {path} is empty (0 bytes); copy or export it again")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ValueError(f"image {path} cannot be decoded; it is damaged or not a PNG or JPEG file")
    if image.dtype != np.uint8:
        raise ValueError(f"image {path} has {image.dtype.itemsize * 8} bits per channel; convert it to 8 bits")
    if image.ndim == 2:
        raise ValueError(f"image {path} is grey; convert it to RGB")
    return np.ascontiguousarray(image[..., 2::-1])


def read_image_float(path: Path) -> Float[np.ndarray, "h w 3"]:
    """As `read_image`, float32 in [0, 1]."""
    return read_image(path).astype(np.float32) / 255


def write_image(
    path: Path, image: UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w 3"], *, jpeg_quality: int = 95
) -> None:
    """Write RGB as PNG or JPEG, by the file's ending. Floats are clipped to [0, 1] and rounded to 8 bits.

    Raises:
        ValueError: another ending, a size of zero, or a value that is not finite.
        OSError: the file cannot be written.
    """
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"cannot write {path}: choose one of the endings {', '.join(FORMATS)}")
    if image.size == 0:
        raise ValueError(f"cannot write {path}: the image has no pixels, its shape is {image.shape}")
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix.lower() != ".png" else []
    ok, encoded = cv2.imencode(path.suffix, np.ascontiguousarray(to_uint8(image)[..., ::-1]), options)
    if not ok:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(encoded.tobytes())


def to_uint8(image: UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """8 bits per channel; floats are clipped to [0, 1] and rounded.

    Raises:
        ValueError: a float is NaN or infinite.
    """
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise ValueError(f"{(~np.isfinite(image)).sum()} of {image.size} values of the image are not finite")
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
