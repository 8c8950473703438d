"""The reference rasterizer: pure torch, any device, float32 and float64, hand-written backward."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.projection import Projected, project
from freqgs_plugin.rendering.base import ALPHA_MIN, BLUR, check_inputs
from freqgs_plugin.rendering.torch_compositing import backward_tiles, conic_gradients, forward_tiles, splat_table
from freqgs_plugin.rendering.torch_tiles import bin_splats
from freqgs_plugin.types import Camera, Rendering, Splats


class TorchRasterizer:
    """Composites splats with torch alone; see `freqgs_plugin.rendering.base.Rasterizer` for the contract."""

    name = "torch"

    def __init__(self, absgrad: bool = True) -> None:
        """`absgrad`: also sum absolute gradients per pixel into `info["means2d"].absgrad` (slower by a quarter)."""
        self.absgrad = absgrad

    def __call__(
        self,
        splats: Splats,
        camera: Camera,
        *,
        background: Float[Tensor, " d"] | None = None,
        blur: float = BLUR,
        antialiased: bool = False,
        depth: bool = True,
    ) -> Rendering:
        """Render `splats`, in the dtype and on the device of its tensors."""
        check_inputs(splats, camera)
        projected = project(splats.means, splats.quats, splats.scales, camera, blur)
        opacities = splats.opacities * projected.compensation if antialiased else splats.opacities
        info = strategy_info(projected, opacities, camera)
        tiles = bin_splats(projected, opacities.detach(), camera)
        features, transmittance, depths = _Composite.apply(
            info["means2d"],
            projected.conics,
            opacities,
            splats.features,
            projected.cov_yy,
            projected.depths.detach() if depth else None,
            tiles,
            (camera.height, camera.width),
            self.absgrad,
        )
        if background is not None:
            features = features + transmittance * background
        return Rendering(features, 1 - transmittance, depths, info)


def strategy_info(projected: Projected, opacities: Float[Tensor, " n"], camera: Camera) -> dict[str, Any]:
    """gsplat's `info` for one camera: what `gsplat.strategy` reads, with a leading camera axis of length 1.

    `means2d` lies on the path of the gradients, so that `retain_grad()` works on it.
    """
    return {
        "means2d": projected.means2d[None],
        "radii": projected.radii[None],
        "depths": projected.depths[None],
        "conics": projected.conics.to(opacities)[None],
        "opacities": opacities[None],
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
        "gaussian_ids": None,
        "camera_ids": None,
    }


class _Composite(torch.autograd.Function):
    """Front-to-back compositing of tiles, for means2d, conics, opacities and features.

    With T_k the transmittance in front of Gaussian k, w_k = alpha_k T_k, g the image gradient and q_k = g . features_k:
    dL/dalpha_k = T_k q_k - R_k / (1 - alpha_k), where R_k = sum_{j>k} w_j q_j + T_end dL/dT_end is what lies behind k.
    """

    @staticmethod
    def forward(ctx, means2d, conics, opacities, features, cov_yy, depths, tiles, size, absgrad):
        table = splat_table(means2d[0], conics, opacities, cov_yy)
        composited = features if depths is None else torch.cat([features, depths[:, None]], dim=-1)
        with torch.autocast(means2d.device.type, enabled=False):
            image, transmittance, used = forward_tiles(table, composited, tiles)
        d = features.shape[1]
        ctx.save_for_backward(means2d, conics, opacities, features, transmittance, used)
        ctx.table, ctx.tiles, ctx.absgrad, ctx.image = table, tiles, absgrad, image[:, :d]
        depth = means2d.new_zeros(*size, 1)
        if depths is not None:
            hit = 1 - transmittance
            depth = tiles.join(image[:, d:] / torch.where(hit > 0, hit, 1.0), *size)
        ctx.mark_non_differentiable(depth)
        return tiles.join(image[:, :d], *size), tiles.join(transmittance, *size), depth

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_features, grad_transmittance, _grad_depth):
        means2d, conics, opacities, features, transmittance, used = ctx.saved_tensors
        tiles, d = ctx.tiles, features.shape[1]
        grad = tiles.split(grad_features)
        behind = (grad * ctx.image).sum(1, keepdim=True) + transmittance * tiles.split(grad_transmittance)
        with torch.autocast(means2d.device.type, enabled=False):
            sums = backward_tiles(ctx.table, features, tiles, used, grad, behind[:, 0], ctx.absgrad)
        moments = sums[:, d : d + 6]
        v_means2d, v_conics = conic_gradients(moments, ctx.table)
        if ctx.absgrad:
            means2d.absgrad = sums[None, :, d + 6 :].contiguous()
        return (
            v_means2d.to(means2d)[None],
            v_conics.to(conics),
            torch.where(opacities >= ALPHA_MIN, moments[:, 0] / opacities.clamp_min(ALPHA_MIN), 0.0),
            sums[:, :d],
            *([None] * 5),
        )
