"""Magnitudes of the 2D discrete Fourier transform: the frequency term (Eq. 7), radial bands, energy per band.

Only half of a real image's spectrum is computed (`[..., h, w // 2 + 1]`, as by `rfft2`); sums count each bin as often
as it occurs in the full plane, so they equal those over `fft2` for even and odd widths. Frequencies are in cycles per
pixel. Half precision is raised to float32: a sum over 10^5 pixels has no place in 10 bits.
"""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.numba_threads import njit, prange
from freqgs_plugin.functional.pyramid import laplacian


def magnitude(image: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch h w2"]:
    """|F(u, v)| of the unnormalised DFT on the half plane w2 = w // 2 + 1; its gradient at magnitude 0 is 0."""
    image = _at_least_float32(image)
    if image.device.type == "cpu" and not (image.requires_grad and torch.is_grad_enabled()):
        return _compiled_magnitude(image)
    with torch.autocast(image.device.type, enabled=False):
        return _differentiable_magnitude(image)


def magnitude_distance(
    a: Float[Tensor, "*batch h w"], b: Float[Tensor, "*batch h w"], norm: Literal["backward", "ortho"] = "backward"
) -> Float[Tensor, ""]:
    """Eq. 7: the mean over u, v, channels and batch of | |F(a)| - |F(b)| |.

    Blind to position: a circularly shifted image has distance 0, so it needs a spatial term beside it.
    With `norm="backward"` (no scaling, as in the paper) the value for white noise grows with sqrt(h w);
    `"ortho"` divides by it, which makes weights comparable between image sizes.
    """
    return magnitude_distance_to(a, magnitude(b), norm)


def magnitude_distance_to(
    pred: Float[Tensor, "*batch h w"],
    target_magnitude: Float[Tensor, "*batch h w2"],
    norm: Literal["backward", "ortho"] = "backward",
) -> Float[Tensor, ""]:
    """`magnitude_distance` to an image of which only `magnitude(target)` is kept, unnormalised whatever `norm` is."""
    height, width = pred.shape[-2:]
    expected = (*pred.shape[:-1], width // 2 + 1)
    if tuple(target_magnitude.shape) != expected:
        got = tuple(target_magnitude.shape)
        raise ValueError(f"magnitudes of {tuple(pred.shape)} images have shape {expected}, got {got}.")
    pred = _at_least_float32(pred)
    if pred.device.type == "cpu" and not target_magnitude.requires_grad:
        distance = _CompiledDistance.apply(pred, target_magnitude)
    else:
        with torch.autocast(pred.device.type, enabled=False):
            difference = (_differentiable_magnitude(pred) - target_magnitude).abs().flatten(0, -2).sum(0)
            distance = (difference * _occurrences(width, difference)).sum() / pred.numel()
    return distance / (height * width) ** 0.5 if norm == "ortho" else distance


def radial_bands(height: int, width: int, levels: int, device: torch.device | str = "cpu") -> Int[Tensor, "h w2"]:
    """Octave band 1..levels of every half-plane bin by its distance from zero frequency.

    Level L holds 1/4 cycles per pixel and above, L - 1 the octave [1/8, 1/4) and so on; level 1 holds the rest.
    """
    rows = torch.fft.fftfreq(height, dtype=torch.float64, device=device)
    columns = torch.fft.rfftfreq(width, dtype=torch.float64, device=device)
    edges = 0.5 ** torch.arange(levels, 1, -1, dtype=torch.float64, device=device)
    return torch.bucketize(torch.hypot(rows[:, None], columns[None]), edges, right=True) + 1


def radial_energy(image: Float[Tensor, "*batch h w"], levels: int) -> Float[Tensor, " levels"]:
    """Mean square per octave of `radial_bands`, batch mean; they sum to the image's mean square (Parseval)."""
    height, width = image.shape[-2:]
    with torch.autocast(image.device.type, enabled=False):
        spectrum = torch.view_as_real(torch.fft.rfft2(_at_least_float32(image))).reshape(-1, height, width // 2 + 1, 2)
        power = spectrum.square().sum(-1).mean(0) * _occurrences(width, spectrum)
        bands = radial_bands(height, width, levels, image.device)
        energy = power.new_zeros(levels).index_add(0, bands.flatten() - 1, power.flatten())
    return energy / (height * width) ** 2


def band_energy(image: Float[Tensor, "b c h w"], levels: int) -> Float[Tensor, " levels"]:
    """Mean square of each Laplacian band, coarse to fine: entry k - 1 belongs to level k, entry 0 (the base) includes
    the mean colour. For k > 1 it is about the squared error of leaving level k out, in units of colour squared.
    """
    return torch.stack([band.square().mean() for band in laplacian(_at_least_float32(image), levels)])


def _at_least_float32(image: Tensor) -> Tensor:
    return image.float() if image.dtype in (torch.float16, torch.bfloat16) else image


def _differentiable_magnitude(image: Tensor) -> Tensor:
    spectrum = torch.view_as_real(torch.fft.rfft2(image))
    square = spectrum.square().sum(-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1).sqrt(), 0)


def _occurrences(width: int, like: Tensor) -> Tensor:
    """How often each column of the half plane occurs in the full plane: twice, except zero and (even width) Nyquist."""
    counts = like.new_full((width // 2 + 1,), 2)
    counts[0] = 1
    if width % 2 == 0:
        counts[-1] = 1
    return counts


def _compiled_magnitude(image: Tensor) -> Tensor:
    image = image.detach()
    planes, (height, width) = image.shape[:-2].numel(), image.shape[-2:]
    out = image.new_empty(planes, height, width // 2 + 1)
    _magnitudes(_paired_spectrum(image).numpy(), out.numpy())
    return out.view(*image.shape[:-1], width // 2 + 1)


class _CompiledDistance(torch.autograd.Function):
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


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def _magnitudes(spectrum, out):
    pairs, height, width = spectrum.shape[:3]
    for task in prange(pairs * height):
        p, u = task // height, task % height
        here, mirrored = spectrum[p, u], spectrum[p, (height - u) % height]
        for v in range(width // 2 + 1):
            a, b = _unpair(here[v], mirrored[(width - v) % width])
            out[2 * p, u, v] = np.sqrt(a[0] * a[0] + a[1] * a[1])
            if 2 * p + 1 < len(out):
                out[2 * p + 1, u, v] = np.sqrt(b[0] * b[0] + b[1] * b[1])


@njit(error_model="numpy", cache=True, nogil=True)
def _difference(value, target):
    """| |F| - T | and the derivative by F, sign(|F| - T) F / |F|, which is 0 where |F| is 0."""
    size = np.sqrt(value[0] * value[0] + value[1] * value[1])
    slope = np.sign(size - target) / size if size > 0 else size
    return abs(size - target), slope * value[0], slope * value[1]


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
