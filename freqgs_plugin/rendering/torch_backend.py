"""The reference rasterizer: pure torch, any device, float32 and float64, hand-written backward.

Memory is O(pixels + intersections): the backward pass repeats the forward products front to back and carries what is left
behind each Gaussian, so nothing is stored per pixel and Gaussian.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.projection import Projected, project
from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN, BLUR, TRANSMITTANCE_MIN
from freqgs_plugin.rendering.torch_tiles import TILE, Tiles, bin_splats, chunks_by_length
from freqgs_plugin.types import Camera, Rendering, Splats

PIXELS = TILE * TILE
GROUP = 512
"""tiles composited together"""
DEPTH_STEP = 8
"""Gaussians per tile composited together: GROUP * DEPTH_STEP * PIXELS numbers fit a CPU's cache"""
INERT = -1e4
"""log opacity of a padding entry: its alpha underflows to 0"""


class TorchRasterizer:
    """Composites splats with torch alone; see `freqgs_plugin.rendering.base.Rasterizer` for the contract."""

    name = "torch"

    def __init__(self, absgrad: bool = True) -> None:
        """`absgrad`: also sum absolute gradients per pixel into `info["means2d"].absgrad` (a quarter more backward time)."""
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
        projected = project(splats.means, splats.quats, splats.scales, camera, blur)
        opacities = splats.opacities * projected.compensation if antialiased else splats.opacities
        info = strategy_info(projected, opacities, camera)
        tiles = bin_splats(projected, opacities.detach(), camera.height, camera.width)
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
        "conics": projected.conics[None],
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
        table = _table(means2d[0], conics, opacities, cov_yy)
        composited = features if depths is None else torch.cat([features, depths[:, None]], dim=-1)
        image, transmittance, used = _forward_tiles(table, _with_inert_row(composited), tiles)
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
        sums = _backward_tiles(ctx.table, _with_inert_row(features), tiles, used, grad, behind[:, 0], ctx.absgrad)[:-1]
        s, sx, sy, sxx, sxy, syy = sums[:, d : d + 6].unbind(-1)
        a, b, c = conics.unbind(-1)
        if ctx.absgrad:
            means2d.absgrad = sums[None, :, d + 6 :]
        return (
            torch.stack([a * sx + b * sy, b * sx + c * sy], dim=-1)[None],
            torch.stack([-0.5 * sxx, -sxy, -0.5 * syy], dim=-1),
            torch.where(opacities >= ALPHA_MIN, s / opacities.clamp_min(ALPHA_MIN), 0.0),
            sums[:, :d],
            *([None] * 5),
        )


def _with_inert_row(x: Float[Tensor, "n d"]) -> Float[Tensor, "n+1 d"]:
    """Append a row of zeros: what padding entries of a tile's list point at."""
    return torch.cat([x, x.new_zeros(1, x.shape[1])])


def _table(
    means2d: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    cov_yy: Float[Tensor, " n"],
) -> Float[Tensor, "n+1 6"]:
    """Per Gaussian: x, y, p, q, r, log opacity, with half the conic's form as (p dx + q dy)^2 + (r dy)^2.

    r^2 = 1 / (2 cov_yy) needs no difference of nearly equal numbers. The last row is inert.
    """
    a, b, _ = conics.unbind(-1)
    p = (a / 2).sqrt()
    log_opacity = torch.log(opacities.clamp_min(torch.finfo(opacities.dtype).tiny))
    table = torch.stack([*means2d.unbind(-1), p, p * b / a, (0.5 / cov_yy).sqrt(), log_opacity], dim=-1)
    inert = table.new_tensor([[0, 0, 0, 0, 0, INERT]])
    return torch.cat([table, inert])


def _basis(like: Float[Tensor, "..."]) -> Float[Tensor, "6 p"]:
    """1, x, y, x^2, xy, y^2 at a tile's pixel centres, px from its middle."""
    axis = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = (c.reshape(-1) for c in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _gather(tiles: Tiles, group: Int[Tensor, " b"], lengths: Int[Tensor, " b"], begin: int, end: int, inert: int):
    """Rows [b, k] of the Gaussians `begin` to `end` of each tile's list; `inert` behind a list's end."""
    k = torch.arange(begin, end, device=group.device)
    entries = tiles.rows[(tiles.starts[group][:, None] + k).clamp_max(tiles.rows.shape[0] - 1)]
    return torch.where(k < lengths[:, None], entries, inert)


def _log_alpha(
    entries: Float[Tensor, "b k 6"], centres: Float[Tensor, "b 2"]
) -> tuple[Float[Tensor, "b k 6"], Float[Tensor, "b k 2"]]:
    """Coefficients of log alpha in `_basis`, and the means relative to the tiles' middles, px."""
    x, y, p, q, r, log_opacity = entries.unbind(-1)
    x, y = x - centres[:, None, 0], y - centres[:, None, 1]
    u, v = -(p * x + q * y), -r * y
    coefficients = torch.stack(
        [log_opacity - u * u - v * v, -2 * p * u, -2 * (q * u + r * v), -p * p, -2 * p * q, -(q * q + r * r)], dim=-1
    )
    return coefficients, torch.stack([x, y], dim=-1)


def _alpha(coefficients: Float[Tensor, "b k 6"], basis: Float[Tensor, "6 p"]):
    """Alpha [b, k, p] with cap and threshold, and where the cap cut it (None: nowhere)."""
    b, k, _ = coefficients.shape
    alpha = (coefficients.view(b * k, 6) @ basis).exp_().view(b, k, -1)
    capped = alpha > ALPHA_MAX
    alpha.clamp_max_(ALPHA_MAX)
    return torch.nn.functional.threshold_(alpha, ALPHA_MIN, 0.0), capped


def _transmittances(
    kept: Float[Tensor, "b k p"], start: Float[Tensor, "b p"]
) -> tuple[Float[Tensor, "b k p"], Float[Tensor, "b p"]]:
    """In front of each Gaussian, and behind the last one. A loop: torch.cumprod is slower."""
    out = torch.empty_like(kept)
    out[:, 0] = start
    for k in range(1, kept.shape[1]):
        torch.mul(out[:, k - 1], kept[:, k - 1], out=out[:, k])
    return out, out[:, -1] * kept[:, -1]


def _forward_tiles(table: Float[Tensor, "m 6"], features: Float[Tensor, "m d"], tiles: Tiles):
    """Composite all tiles: features [t, d, p], transmittance [t, 1, p], and how far each list was read [t]."""
    t, d, basis = tiles.counts.shape[0], features.shape[1], _basis(table)
    image, transmittance = table.new_zeros(t, d, PIXELS), table.new_ones(t, 1, PIXELS)
    used = torch.zeros_like(tiles.counts)
    for group in chunks_by_length(tiles.counts, GROUP):
        lengths, centres = tiles.counts[group], tiles.centres(group, table)
        front = table.new_ones(group.shape[0], PIXELS)
        begin, longest = 0, int(lengths.max())
        while begin < longest:
            end = min(begin + DEPTH_STEP, longest)
            rows = _gather(tiles, group, lengths, begin, end, table.shape[0] - 1)
            alpha, _ = _alpha(_log_alpha(table[rows], centres)[0], basis)
            kept = 1 - alpha
            before, front = _transmittances(kept, front)
            weight = alpha.mul_(before)
            if front.min() <= TRANSMITTANCE_MIN:
                weight.mul_(kept.mul_(before) > TRANSMITTANCE_MIN)
            image[group] += torch.bmm(features[rows].transpose(1, 2), weight)
            transmittance[group, 0] -= weight.sum(1)
            used[group] = lengths.clamp_max(end)
            begin = end
            open_tiles = (front.amax(1) > TRANSMITTANCE_MIN) & (lengths > end)
            if open_tiles.sum() < 0.8 * group.shape[0]:
                group, lengths, centres, front = (x[open_tiles] for x in (group, lengths, centres, front))
                longest = int(lengths.max()) if group.shape[0] else 0
    return image, transmittance, used


def _backward_tiles(
    table: Float[Tensor, "m 6"],
    features: Float[Tensor, "m d"],
    tiles: Tiles,
    used: Int[Tensor, " t"],
    grad: Float[Tensor, "t d p"],
    behind: Float[Tensor, "t p"],
    absgrad: bool,
) -> Float[Tensor, "m s"]:
    """Per Gaussian, summed over pixels: d feature gradients; the moments 1, dx, dy, dx^2, dx dy, dy^2 (d = pixel - mean) of
    S = alpha dL/dalpha; with `absgrad` two absolute gradients by the 2D mean.
    """
    d, basis = features.shape[1], _basis(table)
    sums = table.new_zeros(table.shape[0], d + 6 + 2 * absgrad)
    for group in chunks_by_length(used, GROUP):
        lengths, centres = used[group], tiles.centres(group, table)
        front, rest, g = table.new_ones(group.shape[0], PIXELS), behind[group], grad[group]
        g_transposed = g.transpose(1, 2).contiguous()
        for begin in range(0, int(lengths.max()), DEPTH_STEP):
            end = min(begin + DEPTH_STEP, int(lengths.max()))
            rows = _gather(tiles, group, lengths, begin, end, table.shape[0] - 1)
            coefficients, means = _log_alpha(table[rows], centres)
            alpha, capped = _alpha(coefficients, basis)
            weight, share, front, rest = _shares(alpha, capped, torch.bmm(features[rows], g), front, rest)
            parts = [torch.bmm(weight, g_transposed), _moments(share, means, basis)]
            if absgrad:
                parts.append(_absolute(share, coefficients, basis))
            sums.index_add_(0, rows.view(-1), torch.cat(parts, dim=-1).view(-1, sums.shape[1]))
    return sums


def _shares(
    alpha: Float[Tensor, "b k p"],
    capped: Bool[Tensor, "b k p"],
    q: Float[Tensor, "b k p"],
    front: Float[Tensor, "b p"],
    rest: Float[Tensor, "b p"],
):
    """Weights w and S = alpha dL/dalpha = w q - R alpha / (1 - alpha), both [b, k, p]; transmittance and R [b, p] behind."""
    kept = 1 - alpha
    before, front = _transmittances(kept, front)
    weight = alpha * before
    if front.min() <= TRANSMITTANCE_MIN:
        drawn = kept * before > TRANSMITTANCE_MIN
        weight.mul_(drawn)
        alpha.mul_(drawn)
    q.mul_(weight)
    behind = before
    torch.sub(rest, q[:, 0], out=behind[:, 0])
    for k in range(1, q.shape[1]):
        torch.sub(behind[:, k - 1], q[:, k], out=behind[:, k])
    share = q.addcmul_(behind, alpha.div_(kept), value=-1).masked_fill_(capped, 0)
    return weight, share, front, behind[:, -1].clone()


def _moments(
    share: Float[Tensor, "b k p"], means: Float[Tensor, "b k 2"], basis: Float[Tensor, "6 p"]
) -> Float[Tensor, "b k 6"]:
    """Sums over pixels of `share` times 1, dx, dy, dx^2, dx dy, dy^2 with d = pixel - mean."""
    b, k, p = share.shape
    m, mx, my, mxx, mxy, myy = (share.view(b * k, p) @ basis.T).view(b, k, 6).unbind(-1)
    x, y = means.unbind(-1)
    dx, dy = mx - x * m, my - y * m
    return torch.stack([m, dx, dy, mxx - x * (mx + dx), mxy - x * my - y * dx, myy - y * (my + dy)], dim=-1)


def _absolute(
    share: Float[Tensor, "b k p"], coefficients: Float[Tensor, "b k 6"], basis: Float[Tensor, "6 p"]
) -> Float[Tensor, "b k 2"]:
    """Sums over pixels of |share d(log alpha)/d(pixel)|: gsplat's `absgrad`, px^-1."""
    b, k, p = share.shape
    _, x, y, xx, xy, yy = coefficients.unbind(-1)
    slopes = torch.stack([x, 2 * xx, xy, y, xy, 2 * yy], dim=-1).view(b * k * 2, 3) @ basis[:3]
    return slopes.view(b, k, 2, p).mul_(share[:, :, None]).abs_().sum(-1)
