"""Foveation with fewer pixels: the whole picture is drawn smaller and enlarged, and the fovea once more at full size.

Ours. What leaving out Gaussians cannot save is the time that each pixel of the base takes; outside of the fovea little
is left that needs a pixel of its own. `Foveation` alone decides which Gaussians are drawn, and how strongly.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Camera, Gaussians, Rendering

SEAM = 0.05
"""width of the ring in which the two pictures are blended, share of the longer side"""
MOST = 32
"""times smaller; beyond, nothing is left to enlarge"""
TIMES = (4, 2, 1)
"""choices of `suitable`"""
LEAST = 960
"""px on the longer side that the smaller picture has, by `suitable`"""
_TAIL = math.exp(-4.5)
"""of the Gaussian that blends, at three standard deviations: there the seam ends"""


@dataclass(frozen=True)
class _Window:
    """A rectangle of pixels around the fovea; `right` and `bottom` lie outside."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def pixels(self) -> int:
        return max(self.right - self.left, 0) * max(self.bottom - self.top, 0)


def suitable(camera: Camera) -> int:
    """How many times smaller the picture outside of the fovea may be drawn: as measured in docs/applications.md."""
    return next((times for times in TIMES if max(camera.width, camera.height) >= times * LEAST), 1)


@torch.no_grad()
def render_rescaled(
    gaussians: Gaussians,
    camera: Camera,
    foveation: Foveation,
    attenuation: Attenuation | None = None,
    *,
    times: int = 2,
    rasterizer: Rasterizer,
    background: Float[Tensor, " 3"] | None = None,
    antialiased: bool = True,
    depth: bool = True,
) -> Rendering:
    """The picture under `foveation` (and `attenuation`), outside of the fovea drawn `times` smaller and enlarged.

    The fovea is the foveation's disc, or one of its `sigma` where that is wider. In it, the picture is what `render`
    draws there, but for Gaussians so large that the projection holds their Jacobian within a smaller image's margin.
    Around it, a Gaussian blends over SEAM. Where both pictures together would have as many pixels as one of full size,
    and with `times` 1, it is the picture of `render`. No gradients.

    Raises:
        ValueError: `times` is not in 1..32.
    """
    check_times(times)
    look: dict[str, Any] = {
        "rasterizer": rasterizer, "background": background, "antialiased": antialiased, "depth": depth
    }  # fmt: skip
    weight = foveation(gaussians, camera)
    if attenuation is not None:
        weight = weight * attenuation(gaussians, camera)
    rows = torch.where(weight > 0)[0]
    gaussians, weight = gaussians.select(rows), weight[rows]

    def as_in_full(gaussians: Gaussians, camera: Camera) -> Tensor:
        return weight

    def draw(view: Camera) -> Rendering:
        return render(gaussians, view, as_in_full, **look)

    small = smaller(camera, times)
    radius = max(foveation.radius, foveation.sigma) * max(camera.width, camera.height)
    window = _around(camera, foveation.gaze, radius)
    if times == 1 or small.width * small.height + window.pixels >= camera.width * camera.height:
        return draw(camera)
    outside = draw(small)
    parts = [_enlarged(part, times, camera) for part in (outside.features, outside.alpha, outside.depth)]
    if window.pixels:
        inside = draw(_cropped(camera, window))
        share = _share(camera, foveation.gaze, radius, window).to(parts[0])
        place = slice(window.top, window.bottom), slice(window.left, window.right)
        for part, full in zip(parts, (inside.features, inside.alpha, inside.depth), strict=True):
            part[place] = torch.lerp(part[place], full, share)
    info = {**outside.info, "width": camera.width, "height": camera.height}
    return Rendering(parts[0], parts[1], parts[2], info)


def check_times(times: int) -> None:
    """Refuse what no picture can be made smaller by, with a ValueError."""
    if not 1 <= times <= MOST:
        raise ValueError(f"{times} times smaller: it must be a whole number from 1 to {MOST}.")


def smaller(camera: Camera, times: int) -> Camera:
    """The view with pixels `times` as wide; at the right and the bottom it may show up to one of them more."""
    K = camera.K.clone()
    K[:2] /= times
    return Camera(camera.viewmat, K, math.ceil(camera.width / times), math.ceil(camera.height / times))


def _cropped(camera: Camera, window: _Window) -> Camera:
    K = camera.K.clone()
    K[0, 2] -= window.left
    K[1, 2] -= window.top
    return Camera(camera.viewmat, K, window.right - window.left, window.bottom - window.top)


def _around(camera: Camera, gaze: tuple[float, float], radius: float) -> _Window:
    """What of the image the fovea and its seam may touch; `radius` in px.

    At the border of the image it is as large as elsewhere: the smaller an image, the more Gaussians reach beyond the
    margin within which the projection is exact. Of a gaze too far outside to be seen, nothing.
    """
    reach = radius + SEAM * max(camera.width, camera.height)
    (left, right), (top, bottom) = (
        _span(share * size, reach, size) for share, size in zip(gaze, (camera.width, camera.height), strict=True)
    )
    return _Window(left, top, right, bottom)


def _span(middle: float, reach: float, size: int) -> tuple[int, int]:
    if middle + reach <= 0 or middle - reach >= size:
        return 0, 0
    length = min(math.ceil(2 * reach) + 1, size)
    low = min(max(math.floor(middle - reach), 0), size - length)
    return low, low + length


def _share(camera: Camera, gaze: tuple[float, float], radius: float, window: _Window) -> Float[Tensor, "h w 1"]:
    """Of the full-size picture at each pixel of the window: 1 in the fovea, 0 beyond the seam."""
    y = torch.arange(window.top, window.bottom)[:, None] + 0.5 - gaze[1] * camera.height
    x = torch.arange(window.left, window.right)[None] + 0.5 - gaze[0] * camera.width
    along = (torch.hypot(x, y) - radius).clamp_min(0) / (SEAM * max(camera.width, camera.height))
    bell = torch.exp(-4.5 * along.square())
    return ((bell - _TAIL) / (1 - _TAIL)).clamp_min(0)[..., None]


def _enlarged(image: Float[Tensor, "_ _ d"], times: int, camera: Camera) -> Float[Tensor, "h w d"]:
    """Bilinear, between the centres of pixels, cut to the camera's size."""
    height, width, _ = image.shape
    if image.is_cuda:
        planes = image.permute(2, 0, 1)[None]
        large = torch.nn.functional.interpolate(planes, scale_factor=times, mode="bilinear")[0].permute(1, 2, 0)
    else:
        # the same numbers as torch's in a quarter of the time
        import cv2

        resized = cv2.resize(np.ascontiguousarray(image), (width * times, height * times))
        large = torch.from_numpy(resized.reshape(height * times, width * times, -1))
    return large[: camera.height, : camera.width].contiguous()
