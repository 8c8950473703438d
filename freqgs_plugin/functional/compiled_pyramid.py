"""REDUCE and its gradient on the CPU, compiled: `pyramid.reduce` is the interface. A fifth of a convolution's time."""

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.numba_threads import njit, prange


class CompiledReduce(torch.autograd.Function):
    """One halving of images [b c h w]; linear, so the gradient is the transposed operation."""

    @staticmethod
    def forward(ctx, image: Tensor) -> Tensor:
        ctx.shape = image.shape
        return halve(image.detach())

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor) -> Tensor:
        gradient = upstream.new_zeros(ctx.shape)
        add_halving_gradient(upstream, gradient)
        return gradient


def halve(image: Tensor) -> Tensor:
    """One halving of images [b c h w]."""
    height, width = image.shape[-2:]
    out = image.new_empty(*image.shape[:-2], (height + 1) // 2, (width + 1) // 2)
    _reduce(image.reshape(-1, height, width).contiguous().numpy(), out.view(-1, *out.shape[-2:]).numpy())
    return out


def add_halving_gradient(upstream: Tensor, gradient: Tensor) -> None:
    """Add to `gradient` [b c h w] what `halve` passes back of `upstream` [b c h2 w2]."""
    small = upstream.reshape(-1, *upstream.shape[-2:]).contiguous()
    _reduce_transposed(small.numpy(), gradient.view(-1, *gradient.shape[-2:]).numpy())


@njit(error_model="numpy", inline="always")
def _mirrored(i, side):
    """Index of position i, mirrored about the edge pixels until it lies within [0, side)."""
    if side == 1:
        return 0
    period = 2 * side - 2
    i = i % period
    return min(i, period - i)


@njit(parallel=True, error_model="numpy", cache=True, nogil=True, fastmath={"contract"})
def _reduce(image, out):
    planes, height, width = image.shape
    rows = out.shape[1]
    four, six, scale = image.dtype.type(4), image.dtype.type(6), image.dtype.type(1 / 256)
    for task in prange(planes * rows):
        p, y = task // rows, task % rows
        a, b, c = image[p, _mirrored(2 * y - 2, height)], image[p, _mirrored(2 * y - 1, height)], image[p, 2 * y]
        d, e = image[p, _mirrored(2 * y + 1, height)], image[p, _mirrored(2 * y + 2, height)]
        line = np.empty(width + 4, image.dtype)
        for x in range(width):
            line[x + 2] = a[x] + e[x] + four * (b[x] + d[x]) + six * c[x]
        for x in (-2, -1, width, width + 1):
            line[x + 2] = line[_mirrored(x, width) + 2]
        for x in range(out.shape[2]):
            m = 2 * x
            value = line[m] + line[m + 4] + four * (line[m + 1] + line[m + 3]) + six * line[m + 2]
            out[p, y, x] = scale * value


@njit(parallel=True, error_model="numpy", cache=True, nogil=True, fastmath={"contract"})
def _reduce_transposed(small, out):
    """Add to `out` [planes, h, w] what each pixel of `small` was made of."""
    planes, height, width = out.shape
    rows, columns = small.shape[1:]
    taps = (1.0, 4.0, 6.0, 4.0, 1.0)
    zero, four, six, scale = out.dtype.type(0), out.dtype.type(4), out.dtype.type(6), out.dtype.type(1 / 256)
    for task in prange(planes * height):
        p, y = task // height, task % height
        # down: the rows that this one went into, a zero on either side of them
        line = np.zeros(columns + 2, out.dtype)
        for i in range(max(0, y // 2 - 2), min(rows, y // 2 + 3)):
            weight = 0.0
            for tap in range(5):
                if _mirrored(2 * i + tap - 2, height) == y:
                    weight += taps[tap]
            if weight != 0:
                factor, source = scale * out.dtype.type(weight), small[p, i]
                for x in range(columns):
                    line[x + 1] += factor * source[x]
        # along: even positions from three pixels, odd ones from two; then what lies beyond the edges is mirrored back
        wide = np.empty(2 * columns + 4, out.dtype)
        wide[0], wide[1] = line[1], four * line[1]
        for x in range(columns):
            wide[2 * x + 2] = six * line[x + 1] + line[x] + line[x + 2]
            wide[2 * x + 3] = four * (line[x + 1] + line[x + 2])
        wide[2 * columns + 2], wide[2 * columns + 3] = line[columns], zero
        for x in (-2, -1, width, width + 1):
            wide[_mirrored(x, width) + 2] += wide[x + 2]
        row = out[p, y]
        for x in range(width):
            row[x] += wide[x + 2]
