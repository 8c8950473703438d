"""What each Gaussian adds to a picture, inside of a mask and in all: a by-product of compositing."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.functional.projection import working_dtype
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.types import Camera, Gaussians, Rendering, Splats

VISIBLE = 0.05
"""a view sees a Gaussian of which at least this share gets through what lies in front of it"""


def empty_weights(gaussians: Gaussians) -> Float[Tensor, "n 2"]:
    """`view_weights` of no view."""
    return torch.zeros(len(gaussians), 2, dtype=working_dtype(gaussians.means), device=gaussians.means.device)


def view_weights(
    gaussians: Gaussians,
    camera: Camera,
    mask: Bool[Tensor, "h w"],
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
    attenuation: Attenuation | None = None,
    visible: float | int = VISIBLE,
) -> Float[Tensor, "n 2"]:
    """Weight in front-to-back compositing, summed over the mask's pixels and over all; 0 for what is not seen.

    Both are gradients of sums over pixels, with respect to features that each Gaussian is given for it.
    """
    probe = gaussians.opacities.new_zeros(len(gaussians), 2).requires_grad_()
    with torch.enable_grad():
        picture = composite(
            gaussians, camera, probe, rasterizer=rasterizer, antialiased=antialiased, attenuation=attenuation
        )
        counted = torch.stack([mask.to(picture.features), torch.ones_like(picture.features[..., 0])], -1)
        (picture.features * counted).sum().backward()
    weights = empty_weights(gaussians)
    if probe.grad is not None:
        weights += probe.grad
    seen = weights[:, 1] >= visible * _weight_alone(picture, camera).to(weights)
    return torch.where(seen[:, None], weights, 0.0)


def composite(
    gaussians: Gaussians,
    camera: Camera,
    features: Float[Tensor, "n d"],
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
    attenuation: Attenuation | None = None,
) -> Rendering:
    """A picture of `features` instead of colours, without depth; gradients reach nothing else."""
    opacities = gaussians.opacities.detach()
    if attenuation is not None:
        opacities = opacities * attenuation(gaussians, camera).detach()
    means, quats, scales = (t.detach() for t in (gaussians.means, gaussians.quats, gaussians.scales))
    return rasterizer(Splats(means, quats, scales, opacities, features), camera, antialiased=antialiased, depth=False)


def _weight_alone(picture: Rendering, camera: Camera) -> Float[Tensor, " n"]:
    """The weight with nothing in front: the integral of alpha over the plane, at most that of the whole image, px^2."""
    conics, opacities = picture.info["conics"].detach()[0], picture.info["opacities"].detach()[0]
    a, b, c = conics.to(working_dtype(conics)).unbind(-1)
    determinant = a * c - b * b
    proper = determinant > 0
    area = torch.where(proper, 2 * math.pi / torch.where(proper, determinant, 1.0).sqrt(), math.inf)
    return opacities * area.clamp_max(camera.width * camera.height)
