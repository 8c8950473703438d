"""DFT magnitudes and their distance on the CPU, compiled: `spectrum` is the interface."""

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.numba_threads import njit, prange


def compiled_magnitude(image: Tensor) -> Tensor:
    image = image.detach()
    planes, (height, width) = image.shape[:-2].numel(), image.shape[-2:]
    out = image.new_empty(planes, height, width // 2 + 1)
    _magnitudes(_paired_spectrum(image).numpy(), out.numpy())
    return out.view(*image.shape[:-1], width // 2 + 1)


class CompiledDistance(torch.autograd.Function):
    """Mean of | |F(x)| - T | on CPU: a complex transform per pair of planes, one compiled pass over the bins, and one
    inverse transform for the gradient. Twice to four times as fast as `rfft2` with autograd, most for odd widths,
    whose real transforms are slow in MKL.
    """

    @staticmethod
    def forward(ctx, pred, target):
        pred = pred.detach()
        height, width = pred.shape[-2:]
        spectrum = _paired_spectrum(pred)
        target = target.detach().to(pred.dtype).reshape(-1, height, width // 2 + 1).contiguous()
        sums = np.zeros(spectrum.shape[:2])
        slopes = torch.empty_like(spectrum) if ctx.needs_input_grad[0] else spectrum[:0]
        _compare(spectrum.numpy(), target.numpy(), sums, slopes.numpy())
        ctx.save_for_backward(slopes)
        ctx.shape = pred.shape
        return pred.new_tensor(sums.sum() / pred.numel())

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        pairs = torch.view_as_real(torch.fft.ifft2(torch.view_as_complex(ctx.saved_tensors[0]), norm="forward"))
        gradient = pairs.new_empty(ctx.shape[:-2].numel(), *ctx.shape[-2:])
        scale = upstream / ctx.shape.numel()
        torch.mul(pairs[..., 0], scale, out=gradient[0::2])
        torch.mul(pairs[: len(gradient) // 2, ..., 1], scale, out=gradient[1::2])
        return gradient.view(ctx.shape), None


def _paired_spectrum(image: Tensor) -> Tensor:
    """`[pairs h w 2]`: the full DFT of plane 2p + i * plane 2p + 1 (0 if the number of planes is odd), as reals."""
    planes = image.reshape(-1, *image.shape[-2:])
    pairs = planes.new_zeros((len(planes) + 1) // 2, *image.shape[-2:], 2)
    pairs[..., 0] = planes[0::2]
    pairs[: len(planes) // 2, ..., 1] = planes[1::2]
    return torch.view_as_real(torch.fft.fft2(torch.view_as_complex(pairs)))


@njit(error_model="numpy", cache=True, nogil=True)
def _unpair(here, mirrored):
    """Spectra a, b of two real planes at k, from that of plane + i * plane at k and at -k; each (real, imaginary)."""
    half = here.dtype.type(0.5)
    a = half * (here[0] + mirrored[0]), half * (here[1] - mirrored[1])
    b = half * (here[1] + mirrored[1]), half * (mirrored[0] - here[0])
    return a, b


@njit(error_model="numpy", cache=True, nogil=True)
def _polar(value):
    """|z| and z / |z| (0 at 0); divided by the larger part before squaring, so that nothing over- or underflows."""
    largest = max(abs(value[0]), abs(value[1]))
    if not largest > 0:
        return largest, largest, largest
    real, imaginary = value[0] / largest, value[1] / largest
    length = np.sqrt(real * real + imaginary * imaginary)
    return largest * length, real / length, imaginary / length


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _magnitudes(spectrum, out):
    pairs, height, width = spectrum.shape[:3]
    for task in prange(pairs * height):
        p, u = task // height, task % height
        here, mirrored = spectrum[p, u], spectrum[p, (height - u) % height]
        for v in range(width // 2 + 1):
            a, b = _unpair(here[v], mirrored[(width - v) % width])
            out[2 * p, u, v] = _polar(a)[0]
            if 2 * p + 1 < len(out):
                out[2 * p + 1, u, v] = _polar(b)[0]


@njit(error_model="numpy", cache=True, nogil=True)
def _difference(value, target):
    """| |F| - T | and the derivative by F, sign(|F| - T) F / |F|, which is 0 where |F| is 0."""
    size, real, imaginary = _polar(value)
    sign = np.sign(size - target)
    return abs(size - target), sign * real, sign * imaginary


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _compare(spectrum, target, sums, slopes):
    """Sums of | |F| - T | per row of the full plane, and the derivatives as the spectrum of plane + i * plane."""
    pairs, height, width = spectrum.shape[:3]
    zero = spectrum.dtype.type(0)
    for task in prange(pairs * height):
        p, u, opposite = task // height, task % height, (height - task % height) % height
        here, mirrored = spectrum[p, u], spectrum[p, opposite]
        for v in range(width // 2 + 1):
            a, b = _unpair(here[v], mirrored[(width - v) % width])
            distance, a_real, a_imag = _difference(a, target[2 * p, u, v])
            b_real, b_imag = zero, zero
            if 2 * p + 1 < len(target):
                other, b_real, b_imag = _difference(b, target[2 * p + 1, u, v])
                distance += other
            twice = 0 < v and 2 * v < width  # the bin at -k, in the other half of the plane, is its mirror image
            sums[p, u] += distance * (2 if twice else 1)
            if len(slopes) > 0:
                slopes[p, u, v, 0], slopes[p, u, v, 1] = a_real - b_imag, a_imag + b_real
                if twice:
                    slopes[p, opposite, width - v, 0] = a_real + b_imag
                    slopes[p, opposite, width - v, 1] = b_real - a_imag
