"""Magnitudes of the 2D discrete Fourier transform: the frequency term (Eq. 7), radial bands, energy per band.

Only half of a real image's spectrum is computed (`[..., h, w // 2 + 1]`, as by `rfft2`); sums count each bin as often
as it occurs in the full plane, so they equal those over `fft2` for even and odd widths. Frequencies are in cycles per
pixel. Half precision is raised to float32: a sum over 10^5 pixels has no place in 10 bits.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.pyramid import laplacian

Size = tuple[int, int]
_FAST_FACTORS = (2, 3, 5, 7, 11, 13)


def fast_size(height: int, width: int) -> Size:
    """The least height and width from these on without prime factors above 13.

    Transforms of other sizes take up to five times as long: 840x1297 px 54 ms, 840x1300 px 11 ms (three planes, one
    thread, MKL).
    """
    return _fast_side(height), _fast_side(width)


def _fast_side(side: int) -> int:
    while True:
        rest = side
        for factor in _FAST_FACTORS:
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return side
        side += 1


def magnitude(image: Float[Tensor, "*batch h w"], size: Size | None = None) -> Float[Tensor, "*batch u v2"]:
    """|F(u, v)| of the unnormalised DFT on the half plane v2 = v // 2 + 1; its gradient at magnitude 0 is 0.

    `size` (u, v): of the transform, of an image with zeros to the right and below; None: the image's own.
    """
    size = _transform_size(image, size)
    image = _at_least_float32(image)
    if image.device.type == "cpu" and not (image.requires_grad and torch.is_grad_enabled()):
        from freqgs_plugin.functional.compiled_spectrum import compiled_magnitude

        return compiled_magnitude(image, size)
    with torch.autocast(image.device.type, enabled=False):
        return _differentiable_magnitude(image, size)


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
    pred: Float[Tensor, "*batch h w"] | Sequence[Float[Tensor, "_ *rest h w"]],
    target_magnitude: Float[Tensor, "*batch u v2"],
    norm: Literal["backward", "ortho"] = "backward",
    size: Size | None = None,
    weight: float | int = 1.0,
) -> Float[Tensor, ""]:
    """`weight` times `magnitude_distance` to an image of which only `magnitude(target, size)` is kept.

    Several `pred` count as one, concatenated along the first axis; on CPU that copies nothing. With a `size` of the
    transform that is not the image's, the mean is over its u and v.
    """
    preds = [pred] if isinstance(pred, Tensor) else list(pred)
    shape = preds[0].shape if len(preds) == 1 else (sum(map(len, preds)), *preds[0].shape[1:])
    size = height, width = _transform_size(preds[0], size)
    expected = (*shape[:-2], height, width // 2 + 1)
    if tuple(target_magnitude.shape) != expected:
        got = tuple(target_magnitude.shape)
        raise ValueError(f"magnitudes of {tuple(shape)} images have shape {expected}, got {got}.")
    preds = [_at_least_float32(image) for image in preds]
    if norm == "ortho":
        weight = weight / (height * width) ** 0.5
    if preds[0].device.type == "cpu" and not target_magnitude.requires_grad:
        from freqgs_plugin.functional.compiled_spectrum import CompiledDistance

        return CompiledDistance.apply(target_magnitude, size, weight, *preds)  # pyright: ignore[reportReturnType]
    pred = torch.cat(preds) if len(preds) > 1 else preds[0]
    with torch.autocast(pred.device.type, enabled=False):
        difference = (_differentiable_magnitude(pred, size) - target_magnitude).abs().flatten(0, -2)
        count = len(difference) * width
        return weight * (difference.sum(0) * _occurrences(width, difference)).sum() / count


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


def _transform_size(image: Tensor, size: Size | None) -> Size:
    height, width = image.shape[-2:]
    if size is not None and (size[0] < height or size[1] < width):
        raise ValueError(f"a transform of size {size} would cut a {height}x{width} image. Take at least its size.")
    return (height, width) if size is None else size


def _differentiable_magnitude(image: Tensor, size: Size) -> Tensor:
    return torch.fft.rfft2(image, s=size).abs()


def _occurrences(width: int, like: Tensor) -> Tensor:
    """How often each column of the half plane occurs in the full plane: twice, except zero and (even width) Nyquist."""
    counts = like.new_full((width // 2 + 1,), 2)
    counts[0] = 1
    if width % 2 == 0:
        counts[-1] = 1
    return counts
