"""How much larger Gaussians are drawn while part of the base is missing, so that no holes are seen.

For every cut within the base's cores a factor of all axes is found, by which the cut's pictures come closest to the
whole base's in colour and alpha, and which leaves hardly a hole in any of the views looked through. Factors fall to 1
as the base becomes complete.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.stream.views import judging_views
from freqgs_plugin.types import Camera, Gaussians, Rendering

STEP, MOST = 1.05, 3.0
"""factors that are tried: powers of the one, up to the other"""
VIEWS = 8
"""cameras that are looked through"""
SHARE, COVERED = 0.9, 0.995
"""a pixel with less than the one share of its alpha is a hole; the other share of every view's pixels must be none"""

Draw = Callable[[Gaussians, Camera], Rendering]


def enlargements(base: Gaussians, cuts: Sequence[int], cameras: Sequence[Camera], draw: Draw) -> list[float]:
    """For each number of first rows (rising, the last are all) the factor of their axes.

    Without cameras all are 1.
    """
    found = [1.0] * len(cuts)
    views = judging_views(cameras, VIEWS)
    plain = replace(base, features_rest=torch.zeros_like(base.features_rest))
    wholes = [_picture(draw(plain, camera)) for camera in views]
    factor = 1.0
    for k in range(len(cuts) - 2, -1, -1) if views else ():
        part = plain.select(torch.arange(cuts[k], device=plain.means.device))
        factor = found[k] = _best(part, factor, views, wholes, draw)
    return found


def without_holes(alpha: Float[Tensor, "*size"], whole: Float[Tensor, "*size"]) -> Bool[Tensor, "*size"]:
    """Where a picture has at least `SHARE` of the whole picture's alpha."""
    return alpha >= SHARE * whole


def _best(part: Gaussians, factor: float, views: Sequence[Camera], wholes: Sequence[Tensor], draw: Draw) -> float:
    """The first factor from `factor` on without holes, and from there to where the error rises."""
    error, covered = _compare(part, factor, views, wholes, draw)
    while factor * STEP <= MOST:
        more, now = _compare(part, factor * STEP, views, wholes, draw)
        if more >= error and covered >= COVERED:
            break
        factor, error, covered = factor * STEP, more, now
    return round(factor, 4)


def _compare(
    part: Gaussians, factor: float, views: Sequence[Camera], wholes: Sequence[Tensor], draw: Draw
) -> tuple[float, float]:
    """Squared error of colour and alpha, and the least share of a view without holes."""
    drawn = replace(part, scales=part.scales * factor)
    error, covered = 0.0, 1.0
    for camera, whole in zip(views, wholes, strict=True):
        found = _picture(draw(drawn, camera))
        error += float((found - whole).square().mean())
        covered = min(covered, float(without_holes(found[..., 3], whole[..., 3]).float().mean()))
    return error, covered


def _picture(rendering: Rendering) -> Float[Tensor, "h w 4"]:
    return torch.cat([rendering.features.clamp(0, 1), rendering.alpha], dim=-1)
