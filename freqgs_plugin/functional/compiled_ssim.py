"""SSIM and its gradient on the CPU, compiled: `image_loss.ssim` is the interface, and says which SSIM this is."""

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.image_loss import C1, C2, TAPS
from freqgs_plugin.functional.numba_threads import njit, prange

_STRIP = 32
"""rows that one thread takes at a time: five blurred maps of a strip stay in the second-level cache"""


class CompiledSSIM(torch.autograd.Function):
    """SSIM of planes `[p h w]` with 11 taps per axis; the gradient for the first image is made in the forward pass.

    `centres` [2, p] are subtracted from the planes of both images first: see `image_loss`.
    """

    @staticmethod
    def forward(ctx, x, y, rows, columns, centres):
        x, y = x.detach(), y.detach()
        planes, height, width = x.shape
        rows, columns = (taps.astype(x.numpy().dtype) for taps in (rows, columns))
        inside = (planes, height - TAPS + 1, width - TAPS + 1)
        sums = np.zeros((planes, -(-inside[1] // _STRIP)))
        # derivatives by mean_x, mean_xx and mean_xy per window, with the zeros around that their blur backwards needs
        slopes = np.zeros((3, planes, height + TAPS - 1, width + TAPS - 1), rows.dtype)
        _similarity(x.numpy(), y.numpy(), rows, columns, centres.numpy(), sums, slopes)
        count = inside[0] * inside[1] * inside[2]
        if ctx.needs_input_grad[0]:
            gradient = torch.empty_like(x)
            _similarity_backward(x.numpy(), y.numpy(), rows, columns, centres.numpy(), slopes, gradient.numpy())
            ctx.save_for_backward(gradient.div_(count))
        return x.new_tensor(sums.sum() / count)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return ctx.saved_tensors[0] * upstream, None, None, None, None


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
def _shift(line, centre, out):
    for j in range(line.size):
        out[j] = line[j] - centre


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity_of_row(x, y, xx, yy, xy, centre_x, centre_y, by_x, by_xx, by_xy, out):
    """SSIM of one row of windows from the five blurred maps, and its derivatives by the means of x, x^2 and x y."""
    scalar = x.dtype.type
    zero, one, two, c1, c2 = scalar(0), scalar(1), scalar(2), scalar(C1), scalar(C2)
    for j in range(x.size):
        dx, dy = x[j], y[j]
        a, b = dx + centre_x, dy + centre_y
        per_luminance = one / (a * a + b * b + c1)
        per_variance = one / (max(xx[j] - dx * dx, zero) + max(yy[j] - dy * dy, zero) + c2)
        luminance = (two * a * b + c1) * per_luminance
        structure = (two * (xy[j] - dx * dy) + c2) * per_variance
        value = luminance * structure
        out[j] = value
        by_xy[j] = two * luminance * per_variance
        by_xx[j] = -value * per_variance
        by_x[j] = two * ((b * structure - a * value) * per_luminance + (dx * value - dy * luminance) * per_variance)


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity(x, y, rows, columns, centres, sums, slopes):
    """Per strip of windows: blur every row of x, y, x^2, y^2, x y, then down the strip, then SSIM and derivatives."""
    planes, height, width = x.shape
    strips, wide, tall = sums.shape[1], width - 10, height - 10
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
        count = min(_STRIP, tall - top)
        blurred = np.empty((5, count + 10, wide), x.dtype)
        a, b = np.empty(width, x.dtype), np.empty(width, x.dtype)
        products = np.empty((3, width), x.dtype)
        maps = np.empty((6, wide), x.dtype)
        for i in range(count + 10):
            _shift(x[p, top + i], centres[0, p], a)
            _shift(y[p, top + i], centres[1, p], b)
            for j in range(width):
                products[0, j], products[1, j], products[2, j] = a[j] * a[j], b[j] * b[j], a[j] * b[j]
            _blur_along(a, columns, blurred[0, i])
            _blur_along(b, columns, blurred[1, i])
            for c in range(3):
                _blur_along(products[c], columns, blurred[c + 2, i])
        for i in range(count):
            for c in range(5):
                _blur_across(blurred[c, i : i + 11], rows, maps[c])
            s = slopes[:, p, top + i + 10, 10 : 10 + wide]
            _similarity_of_row(
                maps[0], maps[1], maps[2], maps[3], maps[4], centres[0, p], centres[1, p], s[0], s[1], s[2], maps[5]
            )
            sums[p, task % strips] += maps[5].sum()


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity_backward(x, y, rows, columns, centres, slopes, out):
    """Blurs the three derivative maps back onto the pixels: d/dx = by_x + 2 x by_xx + y by_xy, x and y centred."""
    planes, height, width = x.shape
    strips, two = (height + _STRIP - 1) // _STRIP, x.dtype.type(2)
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
        centre_x, centre_y = centres[0, p], centres[1, p]
        count = min(_STRIP, height - top)
        blurred = np.empty((3, count + 10, width), x.dtype)
        maps = np.empty((3, width), x.dtype)
        for i in range(count + 10):
            for c in range(3):
                _blur_along(slopes[c, p, top + i], columns, blurred[c, i])
        for i in range(count):
            for c in range(3):
                _blur_across(blurred[c, i : i + 11], rows, maps[c])
            a, b, o = x[p, top + i], y[p, top + i], out[p, top + i]
            for j in range(width):
                o[j] = maps[0, j] + two * (a[j] - centre_x) * maps[1, j] + (b[j] - centre_y) * maps[2, j]
