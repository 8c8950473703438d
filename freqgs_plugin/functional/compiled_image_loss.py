"""L1 and SSIM with their gradient on the CPU, compiled: `image_loss` is the interface, and says which SSIM this is."""

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.compiled_rows import row_sum
from freqgs_plugin.functional.image_loss import C1, C2, TAPS
from freqgs_plugin.functional.numba_threads import njit, prange

_STRIP = 32
"""rows that one thread takes at a time: four blurred maps of a strip stay in the second-level cache"""


class CompiledImageSums(torch.autograd.Function):
    """`by_ssim` * (sum of SSIM over windows) + `by_l1` * (sum of |x - y|), of planes `[p h w]`.

    11 taps per axis. The gradient for the first image is made in the forward pass, where it or L1 is wanted.
    `centres` [2, p] are subtracted from the planes of both images before SSIM: see `image_loss`.
    """

    @staticmethod
    def forward(ctx, x, y, rows, columns, centres, by_ssim, by_l1):
        x, y = x.detach(), y.detach()
        planes, height, width = x.shape
        pair, scalar = (x.numpy(), y.numpy()), x.numpy().dtype.type
        taps = rows.astype(scalar), columns.astype(scalar)
        similarity = np.empty((planes, -(-(height - TAPS + 1) // _STRIP)))
        distance = np.zeros((planes, -(-height // _STRIP)))
        # derivatives by mean_x, mean_xx and mean_xy per window, with the zeros around that their blur backwards needs
        slopes = np.zeros((3, planes, height + TAPS - 1, width + TAPS - 1), scalar)
        _similarity(*pair, *taps, centres.numpy(), similarity, slopes)
        if ctx.needs_input_grad[0] or by_l1 != 0:
            gradient = torch.empty_like(x)
            _gradient(*pair, *taps, centres.numpy(), slopes, scalar(by_ssim), scalar(by_l1), distance, gradient.numpy())
            ctx.save_for_backward(gradient)
        return x.new_tensor(by_ssim * similarity.sum() + by_l1 * distance.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return ctx.saved_tensors[0] * upstream, None, None, None, None, None, None


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _blur_along(line, taps, out):
    t0, t1, t2, t3, t4, t5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for j in range(out.size):
        near = t3 * (line[j + 3] + line[j + 7]) + t4 * (line[j + 4] + line[j + 6]) + t5 * line[j + 5]
        far = t0 * (line[j] + line[j + 10]) + t1 * (line[j + 1] + line[j + 9]) + t2 * (line[j + 2] + line[j + 8])
        out[j] = near + far


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _blur_across(lines, taps, out):
    t0, t1, t2, t3, t4, t5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for j in range(out.size):
        near = t3 * (lines[3, j] + lines[7, j]) + t4 * (lines[4, j] + lines[6, j]) + t5 * lines[5, j]
        far = t0 * (lines[0, j] + lines[10, j]) + t1 * (lines[1, j] + lines[9, j]) + t2 * (lines[2, j] + lines[8, j])
        out[j] = near + far


@njit(error_model="numpy", cache=True, nogil=True)
def _moments_of_row(x, y, centre_x, centre_y, centred_x, centred_y, squares, products):
    """What is blurred: x and y without their centres, x^2 + y^2 and x y of those."""
    for j in range(x.size):
        a, b = x[j] - centre_x, y[j] - centre_y
        centred_x[j], centred_y[j] = a, b
        squares[j], products[j] = a * a + b * b, a * b


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity_of_row(x, y, squares, products, centre_x, centre_y, by_x, by_xx, by_xy, out):
    """SSIM of one row of windows from the four blurred maps, and its derivatives by the means of x, x^2 and x y."""
    scalar = x.dtype.type
    zero, one, two, c1, c2 = scalar(0), scalar(1), scalar(2), scalar(C1), scalar(C2)
    for j in range(out.size):
        dx, dy = x[j], y[j]
        a, b = dx + centre_x, dy + centre_y
        per_luminance = one / (a * a + b * b + c1)
        variances = max(squares[j] - dx * dx - dy * dy, zero)
        per_variance = one / (variances + c2)
        luminance = (two * a * b + c1) * per_luminance
        structure = (two * (products[j] - dx * dy) + c2) * per_variance
        value = luminance * structure
        out[j] = value
        by_xy[j] = two * luminance * per_variance
        by_xx[j] = -value * per_variance
        by_x[j] = two * ((b * structure - a * value) * per_luminance + (dx * value - dy * luminance) * per_variance)


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity(x, y, rows, columns, centres, sums, slopes):
    """Per strip of windows: blur the moments along every row, then down the strip, then SSIM and derivatives."""
    planes, height, width = x.shape
    strips, wide, tall = sums.shape[1], width - 10, height - 10
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
        count = min(_STRIP, tall - top)
        blurred = np.empty((4, count + 10, wide), x.dtype)
        lines = np.empty((4, width), x.dtype)
        maps = np.empty((5, wide), x.dtype)
        total = 0.0
        for i in range(count + 10):
            row = top + i
            _moments_of_row(x[p, row], y[p, row], centres[0, p], centres[1, p], lines[0], lines[1], lines[2], lines[3])
            for c in range(4):
                _blur_along(lines[c], columns, blurred[c, i])
        for i in range(count):
            for c in range(4):
                _blur_across(blurred[c, i : i + 11], rows, maps[c])
            # one row of each, not a row of all three: that would be strided, and the loop over it not vectorised
            by_x = slopes[0, p, top + i + 10, 10 : 10 + wide]
            by_xx = slopes[1, p, top + i + 10, 10 : 10 + wide]
            by_xy = slopes[2, p, top + i + 10, 10 : 10 + wide]
            _similarity_of_row(
                maps[0], maps[1], maps[2], maps[3], centres[0, p], centres[1, p], by_x, by_xx, by_xy, maps[4]
            )
            total += row_sum(maps[4])
        sums[p, task % strips] = total


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _gradient_of_row(by_x, by_xx, by_xy, x, y, centre_x, centre_y, by_ssim, by_l1, distance, out):
    """|x - y|, and the weighted gradient of both terms; 0 for the distance where x = y."""
    two = x.dtype.type(2)
    for j in range(out.size):
        difference = x[j] - y[j]
        distance[j] = abs(difference)
        ssim = by_x[j] + two * (x[j] - centre_x) * by_xx[j] + (y[j] - centre_y) * by_xy[j]
        out[j] = by_ssim * ssim + by_l1 * np.sign(difference)


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _gradient(x, y, rows, columns, centres, slopes, by_ssim, by_l1, sums, out):
    """Blurs the three derivative maps back onto the pixels: d/dx = by_x + 2 x by_xx + y by_xy, x and y centred."""
    planes, height, width = x.shape
    strips = sums.shape[1]
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
        count = min(_STRIP, height - top)
        blurred = np.empty((3, count + 10, width), x.dtype)
        maps = np.empty((4, width), x.dtype)
        total = 0.0
        for i in range(count + 10):
            for c in range(3):
                _blur_along(slopes[c, p, top + i], columns, blurred[c, i])
        for i in range(count):
            for c in range(3):
                _blur_across(blurred[c, i : i + 11], rows, maps[c])
            a, b, o = x[p, top + i], y[p, top + i], out[p, top + i]
            _gradient_of_row(maps[0], maps[1], maps[2], a, b, centres[0, p], centres[1, p], by_ssim, by_l1, maps[3], o)
            total += row_sum(maps[3])
        sums[p, task % strips] = total
