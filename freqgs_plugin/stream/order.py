"""Which Gaussians of a level are sent first.

Of the base, those that close most holes (see `covering`). For finer levels that order is wrong: their large Gaussians
correct each other, and some of them alone make the picture worse. There those come first that take most of the squared
error to the level's own picture, at half of the level's opacity.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.covering import covering_order
from freqgs_plugin.stream.views import judging_views
from freqgs_plugin.types import Camera, Gaussians

MOST_VIEWS = 32
"""cameras that are looked through, evenly taken from all"""
HALF = 0.5
"""share of a level's opacity at which its Gaussians are judged"""


def streaming_order(importance: Float[Tensor, " n"], level: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Rows from coarse to fine levels, within a level from the most important on."""
    order = torch.argsort(importance, descending=True, stable=True)
    return order[torch.argsort(level[order], stable=True)]


def importance(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    rasterizer: Rasterizer,
    antialiased: bool,
    attenuation: Attenuation | None = None,
) -> Float[Tensor, " n"]:
    """How early each Gaussian should come among those of its level.

    The time is that of `covering.ROUNDS` small pictures and two more for each further level per camera, about.
    """
    found = torch.zeros_like(gaussians.opacities)
    options = {"rasterizer": rasterizer, "antialiased": antialiased, "attenuation": attenuation}
    base = torch.where(gaussians.level == gaussians.level.min())[0]
    order = covering_order(gaussians.select(base), judging_views(cameras, MOST_VIEWS), **options)
    found[base[order]] = torch.arange(len(order), 0, -1, device=found.device).to(found)
    for camera in cameras[:: max(1, -(-len(cameras) // MOST_VIEWS))]:
        found += _finer_levels(gaussians, camera, **options)
    return found


def size(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """What stands in for `importance` without cameras: opacity times the product of the two larger axes.

    That is about the area that is covered, from wherever one looks.
    """
    axes = gaussians.scales.sort(dim=-1).values
    return gaussians.opacities * axes[:, 1] * axes[:, 2]


def _finer_levels(
    gaussians: Gaussians,
    camera: Camera,
    rasterizer: Rasterizer,
    antialiased: bool,
    attenuation: Attenuation | None,
) -> Float[Tensor, " n"]:
    """0 for the base."""
    found = torch.zeros_like(gaussians.opacities)
    for level in sorted(set(gaussians.level.tolist()))[1:]:
        rows = torch.where(gaussians.level <= level)[0]
        shown = gaussians.select(rows)
        own = shown.level == level
        found[rows[own]] = _gain(shown, own, camera, rasterizer, antialiased, attenuation)[own]
    return found


def _gain(
    gaussians: Gaussians,
    own: Tensor,
    camera: Camera,
    rasterizer: Rasterizer,
    antialiased: bool,
    attenuation: Attenuation | None,
) -> Float[Tensor, " n"]:
    """How the squared error falls with each Gaussian's opacity, times that opacity."""
    weight = 1.0 if attenuation is None else attenuation(gaussians, camera).detach()
    opacities = gaussians.opacities.detach() * weight

    def picture(opacity: Tensor) -> Tensor:
        drawn = replace(gaussians, opacities=opacity)
        return render(drawn, camera, rasterizer=rasterizer, antialiased=antialiased, depth=False).features

    with torch.no_grad():
        target = picture(opacities)
    probe = torch.where(own, HALF * opacities, opacities).requires_grad_()
    with torch.enable_grad():
        (picture(probe) - target).square().sum().backward()
    return torch.zeros_like(opacities) if probe.grad is None else -probe.grad * opacities
