"""Checks of a scene's image files: present, of the camera's size, and of a kind that nerfstudio reads rightly.

nerfstudio 1.1.5 reads pictures by Pillow and demands that their sizes agree with the cameras' to the pixel.
"""

import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from PIL import Image

MAX_AUTO_RESOLUTION = 1600
"""the dataparser halves images until neither side is longer, pixels"""
DECODE_BUDGET = 100_000_000
"""pixels decoded in full to find damaged files; the images are taken evenly from all views"""

Rounding = Literal["floor", "round", "ceil"]
_ROUND: dict[str, Callable[[float], int]] = {
    "floor": math.floor,
    "round": lambda x: math.floor(x + 0.5),
    "ceil": math.ceil,
}


class SceneError(ValueError):
    """A scene that cannot be trained on; the message names the file and the remedy."""


def check_images(
    folder: Path, full: dict[str, tuple[int, int]], factor: int | None, rounding: Rounding
) -> tuple[int, dict[str, tuple[int, int]], list[str]]:
    """Check the image files that the dataparser will read.

    Args:
        folder: where the full-size images are.
        full: the views' names, with width and height of their cameras in pixels.
        factor: the dataparser's `downscale_factor`.
        rounding: its `downscale_rounding_mode`.

    Returns:
        the factor in use, the views' sizes after downscaling, and warnings.

    Raises:
        SceneError: an image is missing, damaged, of another size or of a kind that is misread.
    """
    warnings: list[str] = []
    factor = _downscale_factor(folder, list(full), factor, warnings)
    expected = full
    if factor > 1 and _scaled_folder(folder, factor).is_dir():
        folder, scale = _scaled_folder(folder, factor), _ROUND[rounding]
        expected = {name: (scale(w / factor), scale(h / factor)) for name, (w, h) in full.items()}
    _check_present(folder, list(full))
    _check_headers(folder, expected, factor, warnings)
    _check_decoding(folder, expected)
    return factor, expected, warnings


def _check_present(folder: Path, names: list[str]) -> None:
    if not folder.is_dir():
        raise SceneError(f"the image folder {folder} does not exist; set it with `colmap --images-path`")
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise SceneError(
            f"{len(missing)} of {len(names)} images of the COLMAP model are missing in {folder}: {some(missing)}. "
            "Copy them there, or set the folder with `colmap --images-path`."
        )


def _scaled_folder(folder: Path, factor: int) -> Path:
    return folder.parent / f"{folder.name}_{factor}"


def _downscale_factor(folder: Path, names: list[str], factor: int | None, warnings: list[str]) -> int:
    """The factor that the dataparser will use. Says what happens where its folder is missing."""
    if factor is None:
        if not (folder / names[0]).is_file():
            _check_present(folder, names)
        longest, factor = max(_open(folder / names[0]).size), 1
        while longest / factor > MAX_AUTO_RESOLUTION:
            factor *= 2
    if factor > 1 and not _scaled_folder(folder, factor).is_dir():
        scaled = _scaled_folder(folder, factor)
        if not sys.stdin.isatty() or shutil.which("ffmpeg") is None:
            raise SceneError(
                f"images will be downscaled by {factor}, but {scaled} does not exist, and nerfstudio makes it only in "
                "a terminal with ffmpeg installed. Make it, or end the command with `colmap --downscale-factor 1`."
            )
        warnings.append(f"{scaled} does not exist; nerfstudio will ask whether to make it with ffmpeg")
    return factor


def _open(path: Path) -> Image.Image:
    if path.stat().st_size == 0:
        raise SceneError(f"image {path} is empty (0 bytes); copy or export it again")
    try:
        return Image.open(path)
    except OSError as error:
        raise SceneError(f"image {path} cannot be read ({error}); copy or export it again") from error


def _check_headers(folder: Path, expected: dict[str, tuple[int, int]], factor: int, warnings: list[str]) -> None:
    grey, deep = [], []
    for name, size in expected.items():
        with _open(folder / name) as image:
            if image.size != size:
                raise SceneError(_size_message(folder / name, image.size, size, factor))
            if image.mode == "L":
                grey.append(name)
            elif image.mode not in ("RGB", "RGBA"):
                raise SceneError(
                    f"image {folder / name} has the Pillow mode {image.mode} (palette, 16-bit grey, CMYK or the like), "
                    "whose values nerfstudio misreads. Convert the images to 8-bit RGB."
                )
            elif "16B" in str(getattr(image, "tile", "")):
                deep.append(name)
    if grey:
        warnings.append(f"{len(grey)} grey images, read as RGB with three equal channels: {some(grey)}")
    if deep:
        warnings.append(f"{len(deep)} images of 16 bits per channel, of which the upper 8 are used: {some(deep)}")


def _size_message(path: Path, actual: tuple[int, int], expected: tuple[int, int], factor: int) -> str:
    shown = "x".join(map(str, actual)), "x".join(map(str, expected))
    text = f"image {path} is {shown[0]}, but its COLMAP camera"
    if factor == 1:
        return f"{text} is {shown[1]}. Use the images that COLMAP saw, or rescale the model's cameras."
    return (
        f"{text}, downscaled by {factor}, is {shown[1]}. If they differ by one pixel, another "
        "`colmap --downscale-rounding-mode` (floor, round, ceil) may fit; otherwise make the folder again."
    )


def _check_decoding(folder: Path, expected: dict[str, tuple[int, int]]) -> None:
    pixels = sum(w * h for w, h in expected.values())
    step = math.ceil(pixels / DECODE_BUDGET)
    for name in list(expected)[::step]:
        try:
            with _open(folder / name) as image:
                image.load()
        except (OSError, SyntaxError) as error:
            raise SceneError(f"image {folder / name} is damaged ({error}); copy or export it again") from error


def some(names: list[str], count: int = 3) -> str:
    """The first few names."""
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")
