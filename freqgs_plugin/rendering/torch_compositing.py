"""Front-to-back compositing of tiles in torch, forward and backward.

Memory is O(pixels + intersections): the backward pass repeats the forward products front to back and carries what is
left behind each Gaussian, so nothing is stored per pixel and Gaussian.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.projection import working_dtype
from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from freqgs_plugin.rendering.torch_tiles import TILE, Tiles, chunks_by_length

PIXELS = TILE * TILE
GROUP = 512
"""tiles composited together"""
STEP = 8
"""Gaussians per tile composited together: GROUP * STEP * PIXELS numbers fit a CPU's cache"""
SLAB = 32
"""Gaussians per tile gathered together"""
LOG_UNDERFLOW = -30.0
"""floor of log alpha, far below the threshold: numbers that underflow are slow"""
INERT = -1e4
"""log opacity of a padding entry: its alpha underflows to 0"""


def _with_inert_row(x: Float[Tensor, "n d"]) -> Float[Tensor, "n+1 d"]:
    """Append a row of zeros: what padding entries of a tile's list point at."""
    return torch.cat([x, x.new_zeros(1, x.shape[1])])


def splat_table(
    means2d: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    cov_yy: Float[Tensor, " n"],
) -> Float[Tensor, "n+1 6"]:
    """Per Gaussian: x, y, p, q, r, log opacity, with half the conic's form as u^2 + v^2, u = p dx + q dy, v = r dy.

    r^2 = 1 / (2 cov_yy) needs no difference of nearly equal numbers. The last row is inert.
    """
    a, b, _ = conics.unbind(-1)
    # points without blur have no conic; they are not drawn
    a, cov_yy = torch.where(a > 0, a, 1.0), torch.where(cov_yy > 0, cov_yy, 1.0)
    p = (a / 2).sqrt()
    log_opacity = torch.log(opacities.clamp_min(torch.finfo(opacities.dtype).tiny))
    frame = torch.stack([p, p * b / a, (0.5 / cov_yy).sqrt()], dim=-1).to(means2d)
    table = torch.cat([means2d, frame, log_opacity[:, None]], dim=-1)
    inert = table.new_tensor([[0, 0, 0, 0, 0, INERT]])
    return torch.cat([table, inert])


def _basis(like: Float[Tensor, "..."]) -> Float[Tensor, "6 p"]:
    """1, x, y, x^2, xy, y^2 at a tile's pixel centres, px from its middle."""
    axis = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = (c.reshape(-1) for c in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _take(table: Float[Tensor, "m c"], rows: Int[Tensor, "s b k"]) -> Float[Tensor, "s b k c"]:
    """`table[rows]`, which is three times slower on a CPU."""
    return table.index_select(0, rows.view(-1)).view(*rows.shape, -1)


class _Scratch:
    """Buffers that every step writes into: fresh ones would cost more, in page faults, than the arithmetic."""

    def __init__(self, like: Float[Tensor, "..."]) -> None:
        self._like, self._buffers = like, {}

    def __call__(self, name: str, *shape: int) -> Float[Tensor, "..."]:
        """A contiguous tensor whose contents are undefined and live until the next call with the same name."""
        size = math.prod(shape)
        if name not in self._buffers or self._buffers[name].shape[0] < size:
            self._buffers[name] = self._like.new_empty(size)
        return self._buffers[name][:size].view(shape)


@dataclass(frozen=True)
class _Slab:
    """Coefficients of SLAB consecutive Gaussians for each of b tiles, cut into s steps of k Gaussians."""

    rows: Int[Tensor, "s b k"]
    """rows of the Gaussians; the inert row behind a list's end"""
    frames: Float[Tensor, "s b k 5"]
    """p, q, r of `splat_table`, and u and v at the tile's middle"""
    coefficients: Float[Tensor, "s b k 6"]
    """of log alpha in `_basis`"""
    may_cap: bool
    """some opacity is above `ALPHA_MAX`"""


def _slab(
    table: Float[Tensor, "m 6"],
    tiles: Tiles,
    group: Int[Tensor, " b"],
    lengths: Int[Tensor, " b"],
    begin: int,
    longest: int,
) -> _Slab:
    """Gather Gaussians `begin` to `begin + SLAB` (at most `longest`) of each tile's list."""
    steps = -(-min(SLAB, longest - begin) // STEP)
    k = begin + torch.arange(steps * STEP, device=group.device).view(steps, 1, STEP)
    entries = tiles.rows[(tiles.starts[group][:, None] + k).clamp_max_(tiles.rows.shape[0] - 1)]
    rows = torch.where(k < lengths[:, None], entries, table.shape[0] - 1)
    x, y, p, q, r, log_opacity = _take(table, rows).unbind(-1)
    centre_x, centre_y = tiles.centres(group, table)[:, None].unbind(-1)
    x, y = x - centre_x, y - centre_y
    u, v = -(p * x + q * y), -r * y
    coefficients = torch.stack(
        [log_opacity - u * u - v * v, -2 * p * u, -2 * (q * u + r * v), -p * p, -2 * p * q, -(q * q + r * r)], dim=-1
    )
    return _Slab(
        rows, torch.stack([p, q, r, u, v], dim=-1), coefficients, bool(log_opacity.max() > math.log(ALPHA_MAX))
    )


def _alpha(
    slab: _Slab, step: int, basis: Float[Tensor, "6 p"], scratch: _Scratch
) -> tuple[Float[Tensor, "b k p"], Float[Tensor, "b k p"] | None]:
    """Alpha with cap and threshold, and 1 where the cap did not cut it (None: nowhere did it)."""
    _, b, k, _ = slab.coefficients.shape
    alpha = scratch("alpha", b, k, basis.shape[1])
    torch.mm(slab.coefficients[step].view(b * k, 6), basis, out=alpha.view(b * k, -1)).clamp_min_(LOG_UNDERFLOW)
    alpha.exp_()
    uncapped = None
    if slab.may_cap:
        uncapped = scratch("uncapped", *alpha.shape).copy_(alpha).le_(ALPHA_MAX)
        alpha.clamp_max_(ALPHA_MAX)
    return torch.nn.functional.threshold(alpha, ALPHA_MIN, 0.0, inplace=True), uncapped


def _weights(
    alpha: Float[Tensor, "b k p"], front: Float[Tensor, "b p"], scratch: _Scratch
) -> tuple[Float[Tensor, "b k p"], Float[Tensor, "b k+1 p"]]:
    """w = alpha T, zero once a pixel is finished, and transmittances T in front of each Gaussian and behind the last.

    A loop over k: `torch.cumprod` is slower.
    """
    b, k, p = alpha.shape
    transmittance = scratch("transmittance", b, k + 1, p)
    transmittance[:, 0] = front
    for i in range(k):
        before = transmittance[:, i]
        torch.addcmul(before, alpha[:, i], before, value=-1, out=transmittance[:, i + 1])
    weight = torch.mul(alpha, transmittance[:, :-1], out=scratch("weight", b, k, p))
    if transmittance[:, -1].min() <= TRANSMITTANCE_MIN:
        after = scratch("after", b, k, p).copy_(transmittance[:, 1:])
        weight.mul_(after.gt_(TRANSMITTANCE_MIN))
    return weight, transmittance


def forward_tiles(
    table: Float[Tensor, "m 6"], features: Float[Tensor, "n d"], tiles: Tiles
) -> tuple[Float[Tensor, "t d p"], Float[Tensor, "t 1 p"], Int[Tensor, " t"]]:
    """Composite all tiles: features [t, d, p], transmittance [t, 1, p], and how far each list was read [t]."""
    t, d, basis, scratch = tiles.counts.shape[0], features.shape[1], _basis(table), _Scratch(table)
    features = _with_inert_row(features)
    image, transmittance = table.new_zeros(t, d, PIXELS), table.new_ones(t, 1, PIXELS)
    used = tiles.counts.clone()
    for group in chunks_by_length(tiles.counts, GROUP):
        lengths = tiles.counts[group]
        front = table.new_ones(group.shape[0], PIXELS)
        begin, longest = 0, int(lengths.max())
        while begin < longest:
            slab = _slab(table, tiles, group, lengths, begin, longest)
            colours = _take(features, slab.rows).transpose(2, 3)
            partial, left = image[group], transmittance[group, 0]
            for step in range(slab.rows.shape[0]):
                alpha, _ = _alpha(slab, step, basis, scratch)
                weight, passing = _weights(alpha, front, scratch)
                front = passing[:, -1].clone()
                partial.baddbmm_(colours[step], weight)
                left -= torch.sum(weight, 1)
            image[group], transmittance[group, 0] = partial, left
            begin += SLAB
            finished = front.amax(1) <= TRANSMITTANCE_MIN
            used[group[finished]] = lengths[finished].clamp_max(begin)
            going_on = ~finished & (lengths > begin)
            group, lengths, front = group[going_on], lengths[going_on], front[going_on]
            longest = int(lengths.max()) if group.shape[0] else 0
    return image, transmittance, used


def backward_tiles(
    table: Float[Tensor, "m 6"],
    features: Float[Tensor, "n d"],
    tiles: Tiles,
    used: Int[Tensor, " t"],
    grad: Float[Tensor, "t d p"],
    behind: Float[Tensor, "t p"],
    absgrad: bool,
) -> Float[Tensor, "n s"]:
    """Per Gaussian, summed over pixels: d feature gradients; the moments 1, u, v, u^2, uv, v^2 of S = alpha dL/dalpha
    in the coordinates of `splat_table`; with `absgrad` two absolute gradients by the 2D mean.

    In u and v a Gaussian is round: moments in pixels would lose those across a needle, whatever its length, in float32.
    `grad` is the image's gradient, `behind` its product with the image plus T_end dL/dT_end.
    """
    d, basis, scratch = features.shape[1], _basis(table), _Scratch(table)
    features = _with_inert_row(features)
    sums = table.new_zeros(table.shape[0], d + 6 + 2 * absgrad)
    for group in chunks_by_length(used, GROUP):
        lengths, longest = used[group], int(used[group].max())
        front, rest, g = table.new_ones(group.shape[0], PIXELS), behind[group], grad[group]
        g_transposed = g.transpose(1, 2).contiguous()
        for begin in range(0, longest, SLAB):
            slab = _slab(table, tiles, group, lengths, begin, longest)
            colours = _take(features, slab.rows)
            columns = table.new_empty(*slab.rows.shape, sums.shape[1])
            for step in range(slab.rows.shape[0]):
                alpha, uncapped = _alpha(slab, step, basis, scratch)
                weight, passing = _weights(alpha, front, scratch)
                front = passing[:, -1].clone()
                columns[step, ..., :d] = torch.bmm(weight, g_transposed)
                share, rest = _shares(weight, passing, uncapped, colours[step], g, rest, scratch)
                columns[step, ..., d : d + 6] = (share.view(-1, PIXELS) @ basis.T).view(*share.shape[:2], 6)
                if absgrad:
                    columns[step, ..., d + 6 :] = _absolute(share, slab.coefficients[step], basis, scratch)
            columns[..., d : d + 6] = _round_moments(columns[..., d : d + 6], slab.frames)
            sums.index_add_(0, slab.rows.view(-1), columns.view(-1, sums.shape[1]))
    return sums[:-1]


def _shares(
    weight: Float[Tensor, "b k p"],
    transmittance: Float[Tensor, "b k+1 p"],
    uncapped: Float[Tensor, "b k p"] | None,
    colours: Float[Tensor, "b k d"],
    grad: Float[Tensor, "b d p"],
    rest: Float[Tensor, "b p"],
    scratch: _Scratch,
) -> tuple[Float[Tensor, "b k p"], Float[Tensor, "b p"]]:
    """S = alpha dL/dalpha = w (q - R / T_after), and R behind the last Gaussian; `rest` is R before the first."""
    q = torch.bmm(colours, grad, out=scratch("q", *weight.shape))
    behind = torch.mul(weight, q, out=scratch("behind", *weight.shape))
    for i in range(weight.shape[1]):
        rest = torch.sub(rest, behind[:, i], out=behind[:, i])
    rest = rest.clone()
    # a finished pixel's weight is 0, so the smaller bound only keeps 0 / 0 away
    behind.div_(transmittance[:, 1:].clamp_min_(TRANSMITTANCE_MIN / 2))
    share = q.sub_(behind).mul_(weight)
    return (share if uncapped is None else share.mul_(uncapped)), rest


def _round_moments(moments: Float[Tensor, "s b k 6"], frames: Float[Tensor, "s b k 5"]) -> Float[Tensor, "s b k 6"]:
    """Moments 1, u, v, u^2, uv, v^2 from moments 1, x, y, x^2, xy, y^2 about the tile's middle."""
    m, mx, my, mxx, mxy, myy = moments.unbind(-1)
    p, q, r, u, v = frames.unbind(-1)
    pm, rm = p * mx + q * my, r * my
    mu, mv = u * m + pm, v * m + rm
    muu = u * (mu + pm) + p * p * mxx + 2 * p * q * mxy + q * q * myy
    muv = u * mv + v * pm + r * (p * mxy + q * myy)
    mvv = v * (mv + rm) + r * r * myy
    return torch.stack([m, mu, mv, muu, muv, mvv], dim=-1)


def conic_gradients(
    moments: Float[Tensor, "n 6"], table: Float[Tensor, "m 6"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 3"]]:
    """Gradients by 2D means and by conics a, b, c from the moments of `backward_tiles`, in float64 where there is one.

    dx = (u - q / r v) / p and dy = v / r; by a, b, c the exponent's gradients are -dx^2 / 2, -dx dy, -dy^2 / 2.
    """
    working = working_dtype(moments)
    _, su, sv, suu, suv, svv = moments.to(working).unbind(-1)
    p, q, r = table[:-1, 2:5].to(working).unbind(-1)
    syy = svv / (r * r)
    sxy = (suv / r - q * syy) / p
    sxx = (suu - 2 * q / r * suv + q * q * syy) / (p * p)
    return torch.stack([2 * p * su, 2 * (q * su + r * sv)], -1), torch.stack([-0.5 * sxx, -sxy, -0.5 * syy], -1)


def _absolute(
    share: Float[Tensor, "b k p"], coefficients: Float[Tensor, "b k 6"], basis: Float[Tensor, "6 p"], scratch: _Scratch
) -> Float[Tensor, "b k 2"]:
    """Sums over pixels of |share d(log alpha)/d(pixel)|: gsplat's `absgrad`, px^-1."""
    b, k, p = share.shape
    _, x, y, xx, xy, yy = coefficients.unbind(-1)
    slopes = scratch("slopes", 2, b * k, p)
    for i, slope in enumerate(([x, 2 * xx, xy], [y, xy, 2 * yy])):
        torch.mm(torch.stack(slope, dim=-1).view(b * k, 3), basis[:3], out=slopes[i])
    slopes = slopes.view(2, b, k, p)
    return slopes.mul_(share).abs_().sum(-1).permute(1, 2, 0)
