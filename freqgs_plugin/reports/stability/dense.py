"""The truth for small scenes: every Gaussian at every pixel in float64, by plain autograd. O(pixels x Gaussians).

Shares nothing with the rasterizers but the constants. The projected covariance is never formed: with
A = [J R M, sqrt(b) I] (2 x 5, b the blur) it is A A^T, and with the triangle of A^T = Q T its Mahalanobis distance is
|T^-T d|^2, which keeps half of the digits at an anisotropy of 1e8 where the difference a c - b^2 keeps none.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.rendering.base import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR,
    FOV_MARGIN,
    NEAR_PLANE,
    RADIUS_SIGMAS,
    TRANSMITTANCE_MIN,
)
from freqgs_plugin.types import Camera, Splats


@dataclass(frozen=True)
class _Flat:
    """Gaussians on the image plane."""

    means: Float[Tensor, "n 2"]
    triangles: Float[Tensor, "n 2 2"]
    """upper triangle T with covariance T^T T, px"""
    depths: Float[Tensor, " n"]
    compensation: Float[Tensor, " n"]
    drawn: Tensor
    """boolean [n]"""


def dense(
    splats: Splats,
    camera: Camera,
    background: Float[Tensor, " d"],
    *,
    blur: float = BLUR,
    antialiased: bool = False,
    shift: float = 0.0,
) -> Mapping[str, Tensor]:
    """Features, alpha and depth as a rasterizer returns them; every threshold is multiplied by 1 + `shift`."""
    flat = _flatten(splats, camera, blur, NEAR_PLANE * (1 + shift))
    height, width = camera.height, camera.width
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2).to(flat.means)
    order = torch.argsort(flat.depths.detach(), stable=True)
    order = order[flat.drawn[order]]
    opacities = splats.opacities * flat.compensation if antialiased else splats.opacities
    distance = pixels.T[None] - flat.means[order, :, None]
    scaled = torch.linalg.solve_triangular(flat.triangles[order].mT, distance, upper=False)
    alpha = opacities[order, None] * torch.exp(-0.5 * scaled.square().sum(1))
    alpha = torch.where(alpha > ALPHA_MAX * (1 + shift), ALPHA_MAX, alpha)
    alpha = torch.where(alpha >= ALPHA_MIN * (1 + shift), alpha, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * (after > TRANSMITTANCE_MIN * (1 + shift))
    hit = weight.sum(0)
    features = weight.T @ splats.features[order] + (1 - hit)[:, None] * background
    depth = (weight.T @ flat.depths[order, None])[:, 0] / torch.where(hit > 0, hit, 1.0)
    return {
        "features": features.view(height, width, -1),
        "alpha": hit.view(height, width, 1),
        "depth": depth.detach().view(height, width, 1),
    }


def _flatten(splats: Splats, camera: Camera, blur: float, near: float) -> _Flat:
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    points = splats.means @ rotation.T + translation
    in_front = points[:, 2] > near
    points = torch.where(in_front[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
    depths = points[:, 2]
    focal, centre = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    size = points.new_tensor([camera.width, camera.height])
    tangent = points[:, :2] / depths[:, None]
    means = tangent * focal + centre
    margin = FOV_MARGIN * size / focal
    held = torch.minimum(torch.maximum(tangent, -centre / focal - margin), (size - centre) / focal + margin)
    jacobian = torch.cat([torch.diag(focal).expand(len(points), 2, 2), -(focal * held)[..., None]], -1)
    jacobian = jacobian / depths[:, None, None]
    spread = jacobian @ rotation @ (_rotations(splats.quats) * splats.scales[:, None])
    triangles, det = _triangles(spread, blur)
    minors = torch.linalg.cross(spread[:, 0], spread[:, 1]).square().sum(-1)
    positive = (minors > torch.finfo(minors.dtype).tiny) & (det > 0)
    ratio = torch.where(positive, minors, 1.0) / torch.where(positive, det, 1.0)
    return _Flat(
        means,
        triangles,
        depths,
        torch.where(positive, ratio.sqrt(), 0.0),
        in_front & (det > 0) & _near_image(means, triangles, camera),
    )


def _triangles(spread: Tensor, blur: float) -> tuple[Tensor, Tensor]:
    """Upper triangles T with T^T T = spread spread^T + blur I, and the determinant of that."""
    identity = torch.eye(2, dtype=spread.dtype).expand(len(spread), 2, 2)
    factor = torch.cat([spread, blur**0.5 * identity], -1)
    if blur == 0:
        singular = torch.linalg.cross(spread[:, 0], spread[:, 1]).detach().abs().amax(-1) == 0
        filler = torch.cat([identity, torch.zeros_like(spread)], -1)
        triangles = torch.linalg.qr(torch.where(singular[:, None, None], filler, factor).mT).R
        det = torch.linalg.diagonal(triangles).prod(-1).square()
        return triangles, torch.where(singular, 0.0, det)
    triangles = torch.linalg.qr(factor.mT).R
    return triangles, torch.linalg.diagonal(triangles).prod(-1).square()


def _near_image(means: Tensor, triangles: Tensor, camera: Camera) -> Tensor:
    """Whether the square of 3 standard deviations of the longer axis, rounded up, meets the image."""
    variances = torch.linalg.svdvals(triangles.detach())[:, 0].square()
    trace = triangles.detach().square().sum((1, 2))
    # the smaller variance is never taken to be nearer than 0.2 to the larger: gsplat's floor of 0.01 under a root
    radius = torch.ceil(RADIUS_SIGMAS * torch.maximum(variances, trace / 2 + 0.1).sqrt())
    x, y = means.detach().unbind(-1)
    return (x + radius > 0) & (x - radius < camera.width) & (y + radius > 0) & (y - radius < camera.height)


def _rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices; a quaternion with no component above 1e-20 is the identity."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    defined = largest > 1e-20
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    unit = torch.nn.functional.normalize(
        torch.where(defined, quats / torch.where(defined, largest, 1.0), identity), dim=-1
    )
    w, v = unit[:, 0, None, None], unit[:, 1:]
    zero = torch.zeros_like(v[:, 0])
    x, y, z = v.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
    return torch.eye(3, dtype=quats.dtype) + 2 * w * skew + 2 * skew @ skew
