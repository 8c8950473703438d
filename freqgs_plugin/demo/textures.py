"""Textures of the demo scene: photographs that ship inside the scikit-image wheel, and a few drawn by formula.

Nothing is ever downloaded. Colours are display-referred RGB in [0, 1].
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from jaxtyping import Float

Image = Float[np.ndarray, "h w 3"]
Number = float | int
Colour = tuple[Number, Number, Number]


@dataclass(frozen=True)
class Texture:
    """An image with its mipmaps; level i has half the side of level i-1 (rounded down, at least 1)."""

    image: Image
    repeat: bool = False
    """tile outside of [0, 1] instead of clamping to the border"""
    levels: list[Image] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        levels = [np.ascontiguousarray(self.image, dtype=np.float32)]
        while min(levels[-1].shape[:2]) > 1:
            levels.append(_halve(levels[-1]))
        object.__setattr__(self, "levels", levels)

    def sample(
        self, uv: Float[np.ndarray, "n 2"], texels: Float[np.ndarray, " n"], limit: int = 12
    ) -> Float[np.ndarray, "n 3"]:
        """Colours at `uv` (u right, v down, the image is [0, 1]^2), bilinear in the nearest mipmap.

        `texels` is the side of the footprint of one sample, in texels of the full image; it picks the mipmap.
        """
        last = min(limit, len(self.levels) - 1)
        level = np.clip(np.round(np.log2(np.maximum(texels, 1e-6))), 0, last).astype(np.int32)
        colours = np.empty((len(uv), 3), dtype=np.float32)
        for i in np.unique(level):
            rows = np.flatnonzero(level == i)
            colours[rows] = _bilinear(self.levels[i], uv[rows], self.repeat)
        return colours


def _rgb(colour: Colour) -> Float[np.ndarray, " 3"]:
    return np.array(colour, np.float32)


def _halve(image: Image) -> Float[np.ndarray, "h2 w2 3"]:
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))


def _bilinear(image: Image, uv: Float[np.ndarray, "n 2"], repeat: bool) -> Float[np.ndarray, "n 3"]:
    size = np.array(image.shape[1::-1])
    xy = uv * size.astype(np.float32) - np.float32(0.5)
    corner = np.floor(xy)
    weight = (xy - corner).astype(np.float32)
    low = corner.astype(np.int64)
    high = low + 1
    low, high = (low % size, high % size) if repeat else (np.clip(low, 0, size - 1), np.clip(high, 0, size - 1))
    wx, wy = weight[:, :1], weight[:, 1:]
    top = image[low[:, 1], low[:, 0]] * (1 - wx) + image[low[:, 1], high[:, 0]] * wx
    bottom = image[high[:, 1], low[:, 0]] * (1 - wx) + image[high[:, 1], high[:, 0]] * wx
    return top * (1 - wy) + bottom * wy


@lru_cache(maxsize=64)
def photo(
    name: str,
    tint: Colour | None = None,
    repeat: bool = False,
    crop: tuple[int, int, int, int] | None = None,
) -> Texture:
    """A photograph bundled with scikit-image, by the name of its function in `skimage.data`.

    Args:
        name: for example `astronaut`, `brick`, `moon`; all that the demo uses are public domain or CC0.
        tint: colour by which a grey (or any) image is multiplied.
        repeat: tile the texture.
        crop: top, bottom, left, right in pixels.
    """
    from skimage import data

    image = np.asarray(getattr(data, name)(), dtype=np.float32) / 255
    image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
    if crop is not None:
        image = image[crop[0] : crop[1], crop[2] : crop[3]]
    return Texture(np.clip(image * _rgb(tint or (1, 1, 1)), 0, 1).astype(np.float32), repeat)


def solid(red: Number, green: Number, blue: Number) -> Texture:
    """One colour."""
    return Texture(np.full((1, 1, 3), (red, green, blue), dtype=np.float32))


def gradient(top: Colour, bottom: Colour) -> Texture:
    """A vertical ramp: the smoothest thing in the scene."""
    ramp = np.linspace(0, 1, 64, dtype=np.float32)[:, None, None]
    image = _rgb(top) * (1 - ramp) + _rgb(bottom) * ramp
    return Texture(np.repeat(image, 64, axis=1))


def checker(first: Colour, second: Colour, columns: int, rows: int) -> Texture:
    """A chessboard of `rows` x `columns` fields, 32 texels each."""
    board = (np.add.outer(np.arange(rows * 32) // 32, np.arange(columns * 32) // 32) % 2)[..., None]
    return Texture(np.where(board == 0, _rgb(first), _rgb(second)).astype(np.float32), repeat=True)


def wood(seed: int, size: int = 512) -> Texture:
    """Planks with growth rings: a warped radial sine with fine noise along the grain."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    plank = np.floor(y * 6)
    shift = rng.uniform(0, 9, 6).astype(np.float32)[plank.astype(int)]
    warp = 0.25 * np.sin(2.3 * x * 3 + shift * 3) + 0.1 * np.sin(5.1 * x * 3 + shift * 7)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (9 * (y * 6 - plank) * 0.35 + 2 * warp + shift))
    grain = np.repeat(rng.normal(0, 1, (size, size // 16)), 16, axis=1).astype(np.float32)
    shade = 0.78 + 0.16 * rings + 0.05 * grain + 0.08 * np.sin(shift * 5)
    shade = np.where((y * 6 - plank) < 0.02, 0.45, shade)
    return Texture(np.clip(shade[..., None] * _rgb((0.68, 0.45, 0.26)), 0, 1).astype(np.float32), repeat=True)
