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
        height, width = image.shape[-2:]
        out = image.new_empty(*image.shape[:-2], (height + 1) // 2, (width + 1) // 2)
        _reduce(image.detach().reshape(-1, height, width).contiguous().numpy(), out.view(-1, *out.shape[-2:]).numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor) -> Tensor:
        gradient = upstream.new_zeros(ctx.shape)
        small = upstream.reshape(-1, *upstream.shape[-2:]).contiguous()
        _reduce_transposed(small.numpy(), gradient.view(-1, *ctx.shape[-2:]).numpy())
        return gradient


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
    """Add to `out` [planes, h, w] what each pixel of `small` was made of; planes run in parallel."""
    planes, height, width = out.shape
    one, four, six, scale = out.dtype.type(1), out.dtype.type(4), out.dtype.type(6), out.dtype.type(1 / 256)
    for p in prange(planes):
        for y in range(small.shape[1]):
            line = np.zeros(width + 4, out.dtype)
            for x in range(small.shape[2]):
                value = scale * small[p, y, x]
                line[2 * x] += value
                line[2 * x + 1] += four * value
                line[2 * x + 2] += six * value
                line[2 * x + 3] += four * value
                line[2 * x + 4] += value
            for x in (-2, -1, width, width + 1):
                line[_mirrored(x, width) + 2] += line[x + 2]
            for tap in range(5):
                weight = (one, four, six, four, one)[tap]
                row = out[p, _mirrored(2 * y + tap - 2, height)]
                for x in range(width):
                    row[x] += weight * line[x + 2]
