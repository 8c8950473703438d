"""DFT magnitudes and their distance on the CPU, compiled: `spectrum` is the interface."""

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.compiled_rows import row_sum
from freqgs_plugin.functional.numba_threads import njit, prange


def compiled_magnitude(image: Tensor, size: tuple[int, int]) -> Tensor:
    image = image.detach()
    planes, (height, width) = image.shape[:-2].numel(), size
    out = image.new_empty(planes, height, width // 2 + 1)
    _magnitudes(_paired_spectrum([image], size).numpy(), out.numpy())
    return out.view(*image.shape[:-2], height, width // 2 + 1)


class CompiledDistance(torch.autograd.Function):
    """Mean of | |F(x)| - T | on CPU over images x of one size, T of all of them in order: a complex transform of `size`
    per pair of planes, one compiled pass over the bins, and one inverse transform for the gradient.
    """

    @staticmethod
    def forward(ctx, target, size, *images):
        height, width = size
        target = target.detach().to(images[0].dtype).reshape(-1, height, width // 2 + 1).contiguous()
        spectrum = _paired_spectrum([image.detach() for image in images], size)
        sums = np.zeros(spectrum.shape[:2])
        _compare(spectrum.numpy(), target.numpy(), sums)
        ctx.save_for_backward(spectrum)
        ctx.shapes = [image.shape for image in images]
        return images[0].new_tensor(sums.sum() / (len(target) * height * width))

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        pairs = torch.view_as_real(torch.fft.ifft2(torch.view_as_complex(ctx.saved_tensors[0]), norm="forward"))
        gradients = [upstream.new_empty(shape) for shape in ctx.shapes]
        planes = _planes(gradients)
        scale = upstream / (len(planes) * pairs[0, ..., 0].numel())
        for p, pair in enumerate(pairs):
            _unpack(pair.numpy(), scale.numpy(), planes[2 * p].numpy(), _partner(planes, p).numpy())
        return None, None, *gradients


def _planes(images: list[Tensor]) -> list[Tensor]:
    """The planes `[h w]` of all images in order, contiguous."""
    return [plane for image in images for plane in image.reshape(-1, *image.shape[-2:]).contiguous()]


def _partner(planes: list[Tensor], p: int) -> Tensor:
    """The second of pair p; of an odd number of planes the last one is its own."""
    return planes[min(2 * p + 1, len(planes) - 1)]


def _paired_spectrum(images: list[Tensor], size: tuple[int, int]) -> Tensor:
    """`[pairs u v 2]`: the full DFT of plane 2p + i * plane 2p + 1, each with zeros up to `size`, as reals."""
    planes = _planes(images)
    pairs = planes[0].new_empty((len(planes) + 1) // 2, *size, 2)
    for p, pair in enumerate(pairs):
        _pack(planes[2 * p].numpy(), _partner(planes, p).numpy(), pair.numpy())
    return torch.view_as_real(torch.fft.fft2(torch.view_as_complex(pairs)))


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _pack(first, second, pair):
    for u in prange(len(pair)):
        out = pair[u]
        if u < len(first):
            a, b = first[u], second[u]
            for v in range(a.size):
                out[v, 0], out[v, 1] = a[v], b[v]
            out[a.size :] = 0
        else:
            out[:] = 0


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _unpack(pair, scale, first, second):
    """The opposite of `_pack`, scaled; where both are one plane, its real parts stay."""
    factor = scale[()]
    for u in prange(len(first)):
        a, b, row = first[u], second[u], pair[u]
        for v in range(a.size):
            b[v] = row[v, 1] * factor
        for v in range(a.size):
            a[v] = row[v, 0] * factor


@njit(error_model="numpy", cache=True, nogil=True)
def _separate(spectrum, p, u, parts):
    """Half a row of the spectra of both planes, from that of plane + i * plane at k and at -k.

    `parts` [4, w2]: real and imaginary part of the first plane's, then of the second's.
    """
    height, width = spectrum.shape[1:3]
    here, mirrored = spectrum[p, u], spectrum[p, (height - u) % height]
    half = spectrum.dtype.type(0.5)
    for v in range(width // 2 + 1):
        w = width - v if v > 0 else 0
        parts[0, v] = half * (here[v, 0] + mirrored[w, 0])
        parts[1, v] = half * (here[v, 1] - mirrored[w, 1])
        parts[2, v] = half * (here[v, 1] + mirrored[w, 1])
        parts[3, v] = half * (mirrored[w, 0] - here[v, 0])


@njit(error_model="numpy", cache=True, nogil=True)
def _polar(real, imaginary, size):
    """|z|; real and imaginary part become those of z / |z| (0 at 0).

    Both parts are scaled by the larger one before squaring, so that nothing over- or underflows. No branches: they
    would keep the loop from being vectorised.
    """
    zero, one, least = real.dtype.type(0), real.dtype.type(1), real.dtype.type(np.finfo(real.dtype).tiny)
    for v in range(size.size):
        # the reciprocal of a smaller number would be infinite
        largest = max(abs(real[v]), abs(imaginary[v]), least)
        scale = one / largest
        a, b = real[v] * scale, imaginary[v] * scale
        length = np.sqrt(a * a + b * b)
        size[v] = largest * length
        inverse = one / (one if length == zero else length)
        real[v], imaginary[v] = a * inverse, b * inverse


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _magnitudes(spectrum, out):
    pairs, height, width = spectrum.shape[:3]
    for task in prange(pairs * height):
        p, u = task // height, task % height
        parts = np.empty((4, width // 2 + 1), spectrum.dtype)
        _separate(spectrum, p, u, parts)
        _polar(parts[0], parts[1], out[2 * p, u])
        if 2 * p + 1 < len(out):
            _polar(parts[2], parts[3], out[2 * p + 1, u])


@njit(error_model="numpy", cache=True, nogil=True)
def _difference(real, imaginary, size, target, width):
    """Sum of | |F| - T | over a row of the full plane; real and imaginary part become the derivative's.

    That is sign(|F| - T) F / |F|, which is 0 where |F| is 0.
    """
    _polar(real, imaginary, size)
    for v in range(size.size):
        difference = size[v] - target[v]
        sign = np.sign(difference)
        real[v], imaginary[v], size[v] = sign * real[v], sign * imaginary[v], abs(difference)
    # the bins in the other half of the plane are mirror images of those at 0 < v < width / 2
    alone = size[0] + size[width // 2] if width % 2 == 0 else size[0]
    return 2 * row_sum(size) - alone


@njit(error_model="numpy", cache=True, nogil=True)
def _combine(parts, spectrum, p, u):
    """The opposite of `_separate`."""
    height, width = spectrum.shape[1:3]
    here, mirrored = spectrum[p, u], spectrum[p, (height - u) % height]
    for v in range(width // 2 + 1):
        here[v, 0], here[v, 1] = parts[0, v] - parts[3, v], parts[1, v] + parts[2, v]
    for v in range(1, (width + 1) // 2):
        mirrored[width - v, 0] = parts[0, v] + parts[3, v]
        mirrored[width - v, 1] = parts[2, v] - parts[1, v]


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _compare(spectrum, target, sums):
    """Sums of | |F| - T | per row of the full plane; the spectrum becomes that of the derivatives.

    A row and its mirror image are made of each other, so one task changes both.
    """
    pairs, height, width = spectrum.shape[:3]
    rows = height // 2 + 1
    for task in prange(pairs * rows):
        p, u = task // rows, task % rows
        both = (u, (height - u) % height)
        count = 1 if both[0] == both[1] else 2
        parts, size = np.empty((2, 4, width // 2 + 1), spectrum.dtype), np.empty(width // 2 + 1, spectrum.dtype)
        for i in range(count):
            _separate(spectrum, p, both[i], parts[i])
        for i in range(count):
            total = _difference(parts[i, 0], parts[i, 1], size, target[2 * p, both[i]], width)
            if 2 * p + 1 < len(target):
                total += _difference(parts[i, 2], parts[i, 3], size, target[2 * p + 1, both[i]], width)
            else:
                parts[i, 2:] = 0
            sums[p, both[i]] = total
            _combine(parts[i], spectrum, p, both[i])
