"""DFT magnitudes and their distance on the CPU, compiled: `spectrum` is the interface."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.compiled_rows import row_sum, scaled
from freqgs_plugin.functional.numba_threads import njit, prange


def compiled_magnitude(image: Tensor, size: tuple[int, int]) -> Tensor:
    """|F| [..., u, v // 2 + 1]."""
    planes = planes_of([image.detach()])
    out = image.new_empty(len(planes), size[0], size[1] // 2 + 1)
    for p, spectrum in enumerate(_paired_spectra(planes, size)):
        _magnitudes(spectrum.numpy(), out[2 * p : 2 * p + 2].numpy())
    return out.view(*image.shape[:-2], *out.shape[1:])


def distance(
    planes: list[np.ndarray], target: Tensor, size: tuple[int, int], weight: float, gradients: list[np.ndarray]
) -> float:
    """`weight` times the mean of | |F(x)| - T | over `planes` x `[h w]` and their magnitudes T, `[planes u v2]`.

    Two planes at a time, so that they stay in the second-level cache: one complex transform of `size`, one compiled
    pass over its bins and, unless `gradients` is empty, the transform back into these planes.
    """
    height, width = size
    magnitudes = target.detach().reshape(-1, height, width // 2 + 1).contiguous().numpy()
    factor = weight / (len(planes) * height * width)
    sums = np.zeros((len(planes) + 1) // 2 * height)
    for p, spectrum in enumerate(_paired_spectra(planes, size)):
        _compare(spectrum.numpy(), magnitudes[2 * p : 2 * p + 2], sums[p * height : (p + 1) * height])
        if gradients:
            pair = torch.view_as_real(torch.fft.ifft2(torch.view_as_complex(spectrum), norm="forward")).numpy()
            _unpack(pair, pair.dtype.type(factor), gradients[2 * p], _partner(gradients, p))
    return sums.sum() * factor


class CompiledDistance(torch.autograd.Function):
    """`distance` of images x of one size from T, which is of all of them in order."""

    @staticmethod
    def forward(ctx, target, size, weight, *images):
        wanted = any(ctx.needs_input_grad[3:])
        gradients = [image.new_empty(image.shape if wanted else 0) for image in images]
        parts = planes_of(gradients) if wanted else []
        planes = planes_of([image.detach() for image in images])
        value = distance(planes, target.to(images[0].dtype), size, weight, parts)
        ctx.save_for_backward(*gradients)
        return images[0].new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return None, None, None, *(scaled(gradient, upstream) for gradient in ctx.saved_tensors)


def planes_of(images: Sequence[Tensor]) -> list[np.ndarray]:
    """The planes `[h w]` of all images in order; they share memory with images that are contiguous."""
    return [plane for image in images for plane in image.reshape(-1, *image.shape[-2:]).contiguous().numpy()]


def _partner(planes: list[np.ndarray], p: int) -> np.ndarray:
    """The second of pair p; of an odd number of planes the last one is its own."""
    return planes[min(2 * p + 1, len(planes) - 1)]


def _paired_spectra(planes: list[np.ndarray], size: tuple[int, int]) -> Iterator[Tensor]:
    """`[u v 2]` for each pair: the full DFT of plane 2p + i * plane 2p + 1, each with zeros up to `size`, as reals."""
    packed = np.empty((*size, 2), planes[0].dtype)
    pair = torch.view_as_complex(torch.from_numpy(packed))
    for p in range((len(planes) + 1) // 2):
        _pack(planes[2 * p], _partner(planes, p), packed)
        yield torch.view_as_real(torch.fft.fft2(pair))


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
def _unpack(pair, factor, first, second):
    """The opposite of `_pack`, times `factor`; where both are one plane, its real parts stay."""
    for u in prange(len(first)):
        a, b, row = first[u], second[u], pair[u]
        for v in range(a.size):
            b[v] = row[v, 1] * factor
        for v in range(a.size):
            a[v] = row[v, 0] * factor


@njit(error_model="numpy", cache=True, nogil=True)
def _separate(spectrum, u, parts):
    """Half a row of the spectra of both planes, from that of plane + i * plane at k and at -k.

    `parts` [4, w2]: real and imaginary part of the first plane's, then of the second's.
    """
    height, width = spectrum.shape[:2]
    here, mirrored = spectrum[u], spectrum[(height - u) % height]
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
    """`out` [1 or 2, h, w2] from the spectrum of one or two planes."""
    height, width = spectrum.shape[:2]
    for u in prange(height):
        parts = np.empty((4, width // 2 + 1), spectrum.dtype)
        _separate(spectrum, u, parts)
        for plane in range(len(out)):
            _polar(parts[2 * plane], parts[2 * plane + 1], out[plane, u])


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
def _combine(parts, spectrum, u):
    """The opposite of `_separate`."""
    height, width = spectrum.shape[:2]
    here, mirrored = spectrum[u], spectrum[(height - u) % height]
    for v in range(width // 2 + 1):
        here[v, 0], here[v, 1] = parts[0, v] - parts[3, v], parts[1, v] + parts[2, v]
    for v in range(1, (width + 1) // 2):
        mirrored[width - v, 0] = parts[0, v] + parts[3, v]
        mirrored[width - v, 1] = parts[2, v] - parts[1, v]


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _compare(spectrum, target, sums):
    """Sums of | |F| - T | per row of the full plane, `target` [1 or 2, h, w2]; the spectrum becomes the derivatives'.

    A row and its mirror image are made of each other, so one task changes both.
    """
    height, width = spectrum.shape[:2]
    for task in prange(height // 2 + 1):
        u = np.int64(task)
        both = (u, (height - u) % height)
        count = 1 if both[0] == both[1] else 2
        parts, size = np.zeros((2, 4, width // 2 + 1), spectrum.dtype), np.empty(width // 2 + 1, spectrum.dtype)
        for i in range(count):
            _separate(spectrum, both[i], parts[i])
        for i in range(count):
            for plane in range(len(target)):
                real, imaginary = parts[i, 2 * plane], parts[i, 2 * plane + 1]
                sums[both[i]] += _difference(real, imaginary, size, target[plane, both[i]], width)
            if len(target) == 1:
                parts[i, 2:] = 0
            _combine(parts[i], spectrum, both[i])
