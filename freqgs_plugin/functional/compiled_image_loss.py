"""L1 and SSIM with their gradient on the CPU, compiled: `image_loss` is the interface, and says which SSIM this is."""

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.compiled_rows import row_sum, scaled
from freqgs_plugin.functional.image_loss import C1, C2, TAPS
from freqgs_plugin.functional.numba_lanes import LANES, lanes, load, maximum, store
from freqgs_plugin.functional.numba_threads import njit, prange

_REACH = TAPS - 1
_BLOCK = 4
"""rows that are blurred downwards together, so that each of the 14 below one another is read once"""
_CHUNK = 32
"""rows that go through all steps together: the blurred maps of so many and `_REACH` stay in the second-level cache"""
_DEEP = _CHUNK + _REACH
_SAMPLED_ROWS = 32
"""rows that a plane's mean is estimated from, at least, where it has so many: any number near it does"""
_LEAD = 12
"""rows that a strip computes again above itself: at least `_REACH`, a multiple of `_BLOCK`"""


class CompiledImageSums(torch.autograd.Function):
    """`by_ssim` * (sum of SSIM over windows) + `by_l1` * (sum of |x - y|), of planes `[p h w]`.

    11 taps per axis; a plane has `pixels` of its own, and zeros around them. The gradient for x is made in the forward
    pass.
    """

    @staticmethod
    def forward(ctx, x, y, rows, columns, pixels, by_ssim, by_l1):
        gradient = torch.empty_like(x if ctx.needs_input_grad[0] else x[:0])
        value = image_sums(x.detach(), y.detach(), rows, columns, pixels, by_ssim, by_l1, gradient)
        ctx.save_for_backward(gradient)
        return x.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return scaled(ctx.saved_tensors[0], upstream), None, None, None, None, None, None


def image_sums(
    x: Tensor, y: Tensor, rows: np.ndarray, columns: np.ndarray, pixels: int, by_ssim: float, by_l1: float,
    gradient: Tensor,
) -> float:  # fmt: skip
    """Value of `CompiledImageSums`; its gradient for x is written into `gradient`, `[p h w]` or without elements."""
    planes, height, _ = x.shape
    pair, scalar = (x.numpy(), y.numpy()), x.numpy().dtype.type
    taps = tuple(rows[:6].astype(scalar)), tuple(columns[:6].astype(scalar))
    # about a plane's mean is subtracted before SSIM: variances of bright flat ones are differences of large squares
    step = max(1, height // _SAMPLED_ROWS)
    totals, sums = np.empty((2, planes, -(-height // step))), np.zeros((2, planes, height))
    _row_sums(*pair, step, totals)
    # two strips per thread, each a multiple of the block: where they end changes no bits
    strips = 1 if get_num_threads() == 1 else max(1, -(-2 * get_num_threads() // planes))
    strip = max(_CHUNK, -(-height // (strips * _BLOCK)) * _BLOCK)
    _compare(
        *pair,
        *taps,
        (totals.sum(2) * (height / totals.shape[2] / pixels)).astype(scalar),
        scalar(by_ssim),
        scalar(by_l1),
        strip,
        sums,
        gradient.numpy(),
    )
    return by_ssim * sums[0].sum() + by_l1 * sums[1].sum()


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _row_sums(x, y, step, sums):
    """Of every `step`-th row."""
    planes, rows = sums.shape[1:]
    for task in prange(planes * rows):
        p, i = task // rows, task % rows
        sums[0, p, i], sums[1, p, i] = row_sum(x[p, i * step]), row_sum(y[p, i * step])


def squared_error_as_shown(x: Tensor, y: Tensor) -> float:
    """Sum of (clamp(x, 0, 1) - y)^2 over planes [p h w]."""
    sums = np.empty(x.shape[:2])
    _squared_errors(x.numpy(), y.numpy(), sums)
    return float(sums.sum())


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _squared_errors(x, y, sums):
    planes, height, width = x.shape
    zero, one = x.dtype.type(0), x.dtype.type(1)
    for task in prange(planes * height):
        a, b = x[task // height, task % height], y[task // height, task % height]
        line = np.empty(width, x.dtype)
        for j in range(width):
            value = a[j]
            # comparisons that keep NaN
            value = zero if value < zero else value
            value = one if value > one else value
            line[j] = (value - b[j]) * (value - b[j])
        sums[task // height, task % height] = row_sum(line)


@njit(error_model="numpy", cache=True, nogil=True)
def _weighted(taps, a, b, c, d, e, f, g, h, i, j, k):
    near = taps[3] * (d + h) + taps[4] * (e + g) + taps[5] * f
    return taps[0] * (a + k) + taps[1] * (b + j) + taps[2] * (c + i) + near


@njit(error_model="numpy", cache=True, nogil=True)
def _blur_along(source, at, taps, out, to, count):
    """out[to + v] = the 11 numbers from source[at + v] weighted, for v < count and up to a multiple of LANES."""
    for v in range(0, count, LANES):
        s = at + v
        a, b, c, d = load(source, s), load(source, s + 1), load(source, s + 2), load(source, s + 3)
        e, f, g, h = load(source, s + 4), load(source, s + 5), load(source, s + 6), load(source, s + 7)
        i, j, k = load(source, s + 8), load(source, s + 9), load(source, s + 10)
        store(out, to + v, _weighted(taps, a, b, c, d, e, f, g, h, i, j, k))


@njit(error_model="numpy", cache=True, nogil=True)
def _blur_down(source, at, taps, out, to, pitch, count):
    """As `_blur_along`, of 11 numbers below one another: `_BLOCK` rows `pitch` apart."""
    for v in range(0, count, LANES):
        s, t = at + v, to + v
        a, b = load(source, s), load(source, s + pitch)
        c, d = load(source, s + 2 * pitch), load(source, s + 3 * pitch)
        e, f = load(source, s + 4 * pitch), load(source, s + 5 * pitch)
        g, h = load(source, s + 6 * pitch), load(source, s + 7 * pitch)
        i, j = load(source, s + 8 * pitch), load(source, s + 9 * pitch)
        k, m = load(source, s + 10 * pitch), load(source, s + 11 * pitch)
        n, o = load(source, s + 12 * pitch), load(source, s + 13 * pitch)
        store(out, t, _weighted(taps, a, b, c, d, e, f, g, h, i, j, k))
        store(out, t + pitch, _weighted(taps, b, c, d, e, f, g, h, i, j, k, m))
        store(out, t + 2 * pitch, _weighted(taps, c, d, e, f, g, h, i, j, k, m, n))
        store(out, t + 3 * pitch, _weighted(taps, d, e, f, g, h, i, j, k, m, n, o))


@njit(error_model="numpy", cache=True, nogil=True)
def _moments_of_row(x, y, centre_x, centre_y, lines, pitch):
    """What is blurred: x and y without their centres, x^2 + y^2 and x y of those. Returns the sum of |x - y|."""
    centred_x, centred_y = lines[:pitch], lines[pitch : 2 * pitch]
    squares, products, distance = lines[2 * pitch : 3 * pitch], lines[3 * pitch : 4 * pitch], lines[4 * pitch :]
    for j in range(x.size):
        a, b = x[j] - centre_x, y[j] - centre_y
        centred_x[j], centred_y[j] = a, b
        squares[j], products[j] = a * a + b * b, a * b
        distance[j] = abs(x[j] - y[j])
    return row_sum(distance[: x.size])


@njit(error_model="numpy", cache=True, nogil=True)
def _similarity_of_row(maps, at, step, centre_x, centre_y, slopes, pitch, count):
    """SSIM of one row of windows from the four blurred maps, `step` apart, put behind its three derivatives.

    `slopes`: derivatives by the means of x, x^2 and x y, with `_REACH` zeros on both sides, then SSIM, `pitch` apart.
    """
    scalar = maps.dtype.type
    zero, one, two, c1, c2 = scalar(0), scalar(1), scalar(2), scalar(C1), scalar(C2)
    for j in range(0, count, LANES):
        n, to = at + j, _REACH + j
        dx, dy = load(maps, n), load(maps, n + step)
        a, b = dx + centre_x, dy + centre_y
        per_luminance = one / (a * a + b * b + c1)
        # rounding must not make the variances negative, or the denominator could vanish
        variances = maximum(load(maps, n + 2 * step) - dx * dx - dy * dy, lanes(zero))
        per_variance = one / (variances + c2)
        luminance = (two * a * b + c1) * per_luminance
        structure = (two * (load(maps, n + 3 * step) - dx * dy) + c2) * per_variance
        value = luminance * structure
        by_x = two * ((b * structure - a * value) * per_luminance + (dx * value - dy * luminance) * per_variance)
        store(slopes, to, by_x)
        store(slopes, to + pitch, (zero - value) * per_variance)
        store(slopes, to + 2 * pitch, two * luminance * per_variance)
        store(slopes, to + 3 * pitch, value)
    for c in range(4):
        slopes[c * pitch + _REACH + count : (c + 1) * pitch] = zero
    return row_sum(slopes[3 * pitch + _REACH : 3 * pitch + _REACH + count])


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _gradient_of_row(maps, step, x, y, centre_x, centre_y, by_ssim, by_l1, out):
    """d/dx = by_x + 2 x by_xx + y by_xy, x and y centred, plus that of L1, which is 0 where x = y."""
    by_x, by_xx, by_xy = maps[: x.size], maps[step : step + x.size], maps[2 * step : 2 * step + x.size]
    two = x.dtype.type(2)
    for j in range(x.size):
        ssim = by_x[j] + two * (x[j] - centre_x) * by_xx[j] + (y[j] - centre_y) * by_xy[j]
        out[j] = by_ssim * ssim + by_l1 * np.sign(x[j] - y[j])


@njit(error_model="numpy", cache=True, nogil=True)
def _add_moments(x, y, first, count, slot, taps, centres, lines, blurred, pitch, sums):
    """Blur the moments of `count` rows along them into the rows from `slot` of the four maps; zeros below the image."""
    for i in range(count):
        row = first + i
        if row < len(x):
            sums[row] = _moments_of_row(x[row], y[row], centres[0], centres[1], lines, pitch)
        for c in range(4):
            to = (c * _DEEP + slot + i) * pitch
            if row < len(x):
                _blur_along(lines, c * pitch, taps, blurred, to, x.shape[1] - _REACH)
            else:
                blurred[to : to + pitch] = 0


@njit(error_model="numpy", cache=True, nogil=True)
def _add_slopes(blurred, first, count, shape, rows, columns, centres, maps, slopes, back, pitch, sums):
    """SSIM of `count` rows of windows, and its derivatives blurred along them into the maps `back`; zeros below."""
    tall, width, step = shape[0] - _REACH, shape[1], _BLOCK * pitch
    for i in range(0, count, _BLOCK):
        for c in range(4):
            _blur_down(blurred, (c * _DEEP + i) * pitch, rows, maps, c * step, pitch, width - _REACH)
        for k in range(_BLOCK):
            row = first + i + k
            if row < tall:
                sums[row] = _similarity_of_row(
                    maps, k * pitch, step, centres[0], centres[1], slopes, pitch, width - _REACH
                )
            for c in range(3):
                to = (c * _DEEP + _REACH + i + k) * pitch
                if row < tall:
                    _blur_along(slopes, c * pitch, columns, back, to, width)
                else:
                    back[to : to + pitch] = 0


@njit(error_model="numpy", cache=True, nogil=True)
def _write_gradient(x, y, back, i, taps, centres, by_ssim, by_l1, maps, pitch, out):
    """The gradient of up to `_BLOCK` rows, from the i-th row of `back` on."""
    step = _BLOCK * pitch
    for c in range(3):
        _blur_down(back, (c * _DEEP + i) * pitch, taps, maps, c * step, pitch, x.shape[1])
    for k in range(len(x)):
        line = maps[k * pitch :]
        _gradient_of_row(line, step, x[k], y[k], centres[0], centres[1], by_ssim, by_l1, out[k])


@njit(error_model="numpy", cache=True, nogil=True)
def _keep_last(maps, count, pitch):
    """Move the last `_REACH` rows of each of `count` maps to its beginning."""
    for c in range(count):
        first = c * _DEEP * pitch
        last = first + _CHUNK * pitch
        maps[first : first + _REACH * pitch] = maps[last : last + _REACH * pitch]


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _compare(x, y, rows, columns, centres, by_ssim, by_l1, strip, sums, out):
    """Sums per row: `sums[0]` of SSIM, by a window's first row, and `sums[1]` of |x - y|; the gradient unless empty.

    By strips of rows, and within a strip by chunks: blur the moments along every row, then downwards; SSIM and its
    derivatives by the moments; those blurred back onto the pixels along every row, then downwards.
    """
    planes, height, width = x.shape
    strips = -(-height // strip)
    # an odd number of vectors: rows a power of two apart would compete for the same places of the cache
    pitch = ((width + _REACH) // LANES + 2 | 1) * LANES
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * strip
        a, b, centre, bottom = x[p], y[p], centres[:, p], min(top + strip, height)
        lines, slopes = np.zeros(5 * pitch, x.dtype), np.zeros(4 * pitch, x.dtype)
        blurred, back = np.empty(4 * _DEEP * pitch, x.dtype), np.zeros(3 * _DEEP * pitch, x.dtype)
        maps = np.empty(4 * _BLOCK * pitch, x.dtype)
        start = max(top - _LEAD, 0)
        _add_moments(a, b, start, _REACH, 0, columns, centre, lines, blurred, pitch, sums[1, p])
        for first in range(start, bottom, _CHUNK):
            count = min(_CHUNK, -(-(bottom - first) // _BLOCK) * _BLOCK)
            _add_moments(a, b, first + _REACH, count, _REACH, columns, centre, lines, blurred, pitch, sums[1, p])
            _add_slopes(
                blurred, first, count, a.shape, rows, columns, centre, maps, slopes, back, pitch, sums[0, p]
            )  # fmt: skip
            end = min(first + count, bottom) if len(out) > 0 else 0
            for row in range(max(first, top), end, _BLOCK):
                block = slice(row, min(row + _BLOCK, end))
                _write_gradient(
                    a[block], b[block], back, row - first, rows, centre, by_ssim, by_l1, maps, pitch, out[p, block]
                )
            _keep_last(blurred, 4, pitch)
            _keep_last(back, 3, pitch)
