"""An oracle: dense per-pixel compositing by plain autograd, on gsplat's own torch projection. O(pixels x Gaussians)."""

from dataclasses import dataclass

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN, NEAR_PLANE, TRANSMITTANCE_MIN


@dataclass
class Dense:
    features: torch.Tensor  # [h, w, d]
    alpha: torch.Tensor  # [h, w, 1]
    depth: torch.Tensor  # [h, w, 1]
    means2d: torch.Tensor  # [n, h * w, 2]: one copy per pixel, so that its gradient is per pixel

    @property
    def means2d_grad(self):
        return self.means2d.grad.sum(1)

    @property
    def absgrad(self):
        return self.means2d.grad.abs().sum(1)


def projection(splats, camera, blur):
    """gsplat's radii, means2d, depths, conics and compensations of one camera."""
    covariances, _ = _quat_scale_to_covar_preci(splats.quats, splats.scales, compute_preci=False)
    out = _fully_fused_projection(
        splats.means, covariances, camera.viewmat[None], camera.K[None], camera.width, camera.height,
        eps2d=blur, near_plane=NEAR_PLANE, calc_compensations=True,
    )  # fmt: skip
    return tuple(x[0] for x in out)


def render_dense(splats, camera, *, background=None, blur=0.3, antialiased=False):
    radii, means2d, depths, conics, compensations = projection(splats, camera, blur)
    opacities = splats.opacities * compensations if antialiased else splats.opacities
    return composite_dense(
        means2d, depths, conics, opacities, splats.features, radii, (camera.height, camera.width), background
    )


def composite_dense(means2d, depths, conics, opacities, features, radii, size, background=None):
    h, w = size
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(1, h * w, 2).to(means2d)
    means2d = means2d[:, None].expand(-1, h * w, -1).clone()
    if means2d.requires_grad:
        means2d.retain_grad()
    order = torch.argsort(depths.detach(), stable=True)
    order = order[radii[order] > 0]
    dx, dy = (means2d[order] - pixels).unbind(-1)
    a, b, c = conics[order, :, None].unbind(1)
    alpha = opacities[order, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = alpha.clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * (after > TRANSMITTANCE_MIN)
    hit = weight.sum(0)
    features_of_order = features[order]
    features = torch.einsum("np,nd->pd", weight, features_of_order)
    if background is not None:
        features = features + (1 - hit)[:, None] * background
    depth = (weight * depths[order, None]).sum(0).detach() / torch.where(hit > 0, hit, 1.0).detach()
    shape = (h, w, -1)
    return Dense(features.view(shape), hit.view(shape), depth.view(shape), means2d)
