"""Which Gaussians touch which tile of the image, front to back: the sort behind the torch compositor."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.projection import Projected
from freqgs_plugin.rendering.base import ALPHA_MIN, check_entries
from freqgs_plugin.types import Camera

TILE = 8
"""side of a tile, px"""


@dataclass(frozen=True)
class Tiles:
    """Lists of Gaussians, one per tile, each ordered by depth (equal depths by row)."""

    rows: Int[Tensor, " i"]
    """rows of the Gaussians, tile after tile"""
    counts: Int[Tensor, " t"]
    """entries of `rows` per tile, tiles in row-major order"""
    starts: Int[Tensor, " t"]
    """where each tile's entries begin"""
    across: int
    """tiles per row of the image"""
    down: int
    """tiles per column of the image"""

    def centres(self, tiles: Int[Tensor, " b"], like: Float[Tensor, "..."]) -> Float[Tensor, "b 2"]:
        """Middle of each tile, px."""
        column, row = tiles % self.across, torch.div(tiles, self.across, rounding_mode="floor")
        return torch.stack([column, row], dim=-1).to(like) * TILE + TILE / 2

    def split(self, image: Float[Tensor, "h w d"]) -> Float[Tensor, "t d p"]:
        """Cut an image into tiles of p pixels, padded with zeros."""
        h, w, d = image.shape
        padded = torch.nn.functional.pad(image, (0, 0, 0, self.across * TILE - w, 0, self.down * TILE - h))
        tiled = padded.reshape(self.down, TILE, self.across, TILE, d).permute(0, 2, 4, 1, 3)
        return tiled.reshape(self.down * self.across, d, TILE * TILE)

    def join(self, tiled: Float[Tensor, "t d p"], height: int, width: int) -> Float[Tensor, "h w d"]:
        """The image whose tiles are `tiled`: inverse of `split`."""
        d = tiled.shape[1]
        image = tiled.view(self.down, self.across, d, TILE, TILE).permute(0, 3, 1, 4, 2)
        return image.reshape(self.down * TILE, self.across * TILE, d)[:height, :width]


def chunks_by_length(lengths: Int[Tensor, " t"], size: int) -> Iterator[Int[Tensor, " b"]]:
    """Tiles in groups of `size`, longest lists first, so that a group wastes few lanes on shorter ones."""
    order = torch.argsort(lengths, descending=True, stable=True)[: int((lengths > 0).sum())]
    if order.shape[0]:
        yield from order.split(size)


@torch.no_grad()
def bin_splats(projected: Projected, opacities: Float[Tensor, " n"], camera: Camera) -> Tiles:
    """List, for every tile, the Gaussians with a pixel centre where alpha >= 1/255.

    That is the ellipse `d^T conic d <= L` with `L = 2 ln(255 opacity)`. Its span is exact for every row of tiles: first
    the (Gaussian, row of tiles) pairs are listed, then the tiles that each pair spans.
    """
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    candidates = torch.nonzero(projected.visible & (opacities >= ALPHA_MIN)).squeeze(1)
    candidates = candidates[torch.argsort(projected.depths[candidates], stable=True)]
    reach = 2 * torch.log(opacities[candidates] / ALPHA_MIN)
    y, ry = projected.means2d[candidates, 1], (reach * projected.cov_yy[candidates]).sqrt()
    first, last = _tile_range(y - ry, y + ry, down)
    pair, tile_y = _expand(first, last)
    left, right = _row_span(projected, candidates, reach, pair, tile_y)
    first, last = _tile_range(left, right, across)
    check_entries(int((last - first + 1).sum()), len(candidates), camera)
    entry, tile_x = _expand(first, last)
    tiles = across * down
    tile = (tile_y[entry] * across + tile_x).to(torch.int16 if tiles < 2**15 else torch.int32)
    tile, order = torch.sort(tile, stable=True)
    counts = torch.bincount(tile, minlength=tiles)
    return Tiles(candidates[pair[entry[order]]], counts, torch.cumsum(counts, 0) - counts, across, down)


def _row_span(
    projected: Projected,
    candidates: Int[Tensor, " c"],
    reach: Float[Tensor, " c"],
    pair: Int[Tensor, " r"],
    tile_y: Int[Tensor, " r"],
) -> tuple[Float[Tensor, " r"], Float[Tensor, " r"]]:
    """Leftmost and rightmost x, px, of each pair's ellipse between the outer pixel centres of its row of tiles."""
    a, b, c = projected.conics.index_select(0, candidates).unbind(-1)
    rx = (reach * projected.cov_xx[candidates]).sqrt()
    ry = (reach * projected.cov_yy[candidates]).sqrt()
    x, y = projected.means2d[candidates].unbind(-1)
    slack = 1e-3 + 1e-6 * (rx + ry + x.abs())
    per_splat = torch.stack([x, y, rx / c * b, ry, reach, a, b, projected.cov_yy[candidates], slack], dim=-1)
    x, y, lean, ry, reach, a, b, cov_yy, slack = per_splat.index_select(0, pair).unbind(-1)
    top = torch.maximum(tile_y * TILE + 0.5 - y, -ry)
    bottom = torch.maximum(torch.minimum(tile_y * TILE + (TILE - 0.5) - y, ry), top)

    def half_width(dy: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
        return ((reach - dy * dy / cov_yy).clamp_min(0) / a).sqrt()

    # the ellipse is widest to the right at dy = -lean and to the left at dy = lean
    dy_right = torch.minimum(torch.maximum(-lean, top), bottom)
    dy_left = torch.minimum(torch.maximum(lean, top), bottom)
    shear = b / a
    return x - shear * dy_left - half_width(dy_left) - slack, x - shear * dy_right + half_width(dy_right) + slack


def _tile_range(
    low: Float[Tensor, " m"], high: Float[Tensor, " m"], tiles: int
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """First and last of `tiles` tiles along an axis with a pixel centre in [low, high] px (last < first: none)."""
    size = tiles * TILE
    first = torch.ceil(low - 0.5).clamp(0, size).long()
    last = torch.floor(high - 0.5).clamp(-1, size - 1).long()
    empty = last < first
    first = torch.div(first, TILE, rounding_mode="floor")
    last = torch.div(last, TILE, rounding_mode="floor")
    return first, torch.where(empty, first - 1, last)


def _expand(first: Int[Tensor, " m"], last: Int[Tensor, " m"]) -> tuple[Int[Tensor, " e"], Int[Tensor, " e"]]:
    """All (index, value) with first[index] <= value <= last[index], in order."""
    counts = last - first + 1
    index = torch.repeat_interleave(counts)
    offset = first - (torch.cumsum(counts, 0) - counts)
    return index, torch.arange(index.shape[0], device=first.device) + offset[index]
