"""Gaussian and Laplacian pyramids (Burt and Adelson 1983), exact for every image size. Tensors are BCHW.

The paper uses two different ways down: `low_pass` (bilinear, Eq. 6) makes the targets of the frequency term, and
`reduce` (5-tap Gaussian, Eq. 9) brings target and prediction to the size at which the image term compares them.

Sizes per halving: `low_pass` goes through floor(side / 2), at least 1; `reduce` gives ceil(side / 2).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_TAPS = (1.0, 4.0, 6.0, 4.0, 1.0)


def low_pass(image: Float[Tensor, "b c h w"], times: int) -> Float[Tensor, "b c h w"]:
    """I_k = ((I) down^times) up^times of Eq. 6: bilinear x0.5, then bilinear x2 back to the recorded sizes.

    Bilinear x0.5 without antialiasing and with `align_corners=False` samples midway between pixels, so it is the plain
    mean of each 2x2 block. An odd side drops its last row on the way down (floor) and repeats it on the way up: the
    factor stays exactly 2 and content stays where it was, whereas stretching to the odd size would shift it by up to
    half a pixel per halving. A side of 1 stays 1.
    """
    sizes = []
    for _ in range(times):
        height, width = image.shape[-2:]
        sizes.append((height, width))
        image = F.avg_pool2d(image, (min(2, height), min(2, width)))
    for height, width in reversed(sizes):
        doubled = _double(_double(image, -2), -1)[..., :height, :width]
        missing = (0, width - doubled.shape[-1], 0, height - doubled.shape[-2])
        image = F.pad(doubled, missing, mode="replicate") if any(missing) else doubled
    return image


def _double(image: Float[Tensor, "b c h w"], axis: int) -> Float[Tensor, "b c h2 w2"]:
    """Bilinear x2 along one axis, `align_corners=False`: 3/4 of the nearer pixel and 1/4 of the other, edges repeated.

    `F.interpolate` does the same, but to other last bits with another number of threads.
    """
    size = image.shape[axis]
    before = torch.cat([image.narrow(axis, 0, 1), image.narrow(axis, 0, size - 1)], axis)
    after = torch.cat([image.narrow(axis, 1, size - 1), image.narrow(axis, size - 1, 1)], axis)
    pair = torch.stack([0.75 * image + 0.25 * before, 0.75 * image + 0.25 * after], image.dim() + axis + 1)
    return pair.flatten(image.dim() + axis, image.dim() + axis + 1)


def reduce(image: Float[Tensor, "b c h w"], times: int = 1) -> Float[Tensor, "b c h2 w2"]:
    """REDUCE^times of Eq. 9: convolve with [1, 4, 6, 4, 1] / 16 along both axes, keep every second row and column.

    The output side is ceil(side / 2) and output pixel i is centred on input pixel 2i. Borders mirror without repeating
    the edge. Values and sizes are those of OpenCV's `pyrDown` at every size; kornia's `pyrdown` blurs with the same
    kernel but then resamples bilinearly to floor(side / 2), which is a different (and wider) filter.
    """
    if image.device.type == "cpu" and image.dtype in (torch.float32, torch.float64) and image.numel():
        from freqgs_plugin.functional.compiled_pyramid import CompiledReduce

        for _ in range(times):
            image = CompiledReduce.apply(image)  # pyright: ignore[reportAssignmentType]
        return image
    return reduce_by_convolution(image, times)


def reduce_by_convolution(image: Float[Tensor, "b c h w"], times: int = 1) -> Float[Tensor, "b c h2 w2"]:
    """`reduce` on any device and in any dtype."""
    for _ in range(times):
        # one strided 5x5 depthwise convolution: on CPU a third of the time of blurring everything and then slicing
        image = _convolve(_mirror(image), _kernel(image), stride=2, groups=image.shape[1])
    return image


def expand(image: Float[Tensor, "b c h2 w2"], size: tuple[int, int]) -> Float[Tensor, "b c h w"]:
    """EXPAND of Burt and Adelson to `size` = (height, width): put pixel i at 2i, zeros between, blur, restore the gain.

    Constants stay constant at every size. The input must have the size that `reduce` gives for `size`.
    """
    height, width = size
    expected = ((height + 1) // 2, (width + 1) // 2)
    if tuple(image.shape[-2:]) != expected:
        got = tuple(image.shape[-2:])
        raise ValueError(f"expand to {size} needs an image of {expected}, got {got}. Pass the size before `reduce`.")
    spread = image.new_zeros(*image.shape[:2], height, width)
    spread[..., ::2, ::2] = image
    # half of the taps of an axis fall on zeros, except where a side of 1 is its own mirror image
    gain = (2 if height > 1 else 1) * (2 if width > 1 else 1)
    return _convolve(_mirror(spread), gain * _kernel(image), groups=image.shape[1])


def laplacian(image: Float[Tensor, "b c h w"], levels: int) -> list[Float[Tensor, "b c _ _"]]:
    """The Laplacian pyramid, coarse to fine as levels are numbered in the paper: `bands[0]` is the base (level 1).

    `bands[k - 1]` has the size after `levels - k` reductions. `collapse` inverts it up to rounding at every size.
    """
    if levels < 1:
        raise ValueError(f"a pyramid needs at least 1 level, got {levels}.")
    bands = []
    for _ in range(levels - 1):
        smaller = reduce(image)
        bands.append(image - expand(smaller, (image.shape[-2], image.shape[-1])))
        image = smaller
    return [image, *reversed(bands)]


def collapse(bands: list[Float[Tensor, "b c _ _"]]) -> Float[Tensor, "b c h w"]:
    """The image of a Laplacian pyramid given coarse to fine; the first k bands alone give Gaussian-pyramid level k."""
    image = bands[0]
    for band in bands[1:]:
        image = band + expand(image, (band.shape[-2], band.shape[-1]))
    return image


def max_levels(height: int, width: int, min_side: int = 16) -> int:
    """The most levels L with min(height, width) / 2^(L-1) >= `min_side` pixels; at least 1."""
    return max(1, (min(height, width) // min_side).bit_length())


def _convolve(image: Tensor, kernel: Tensor, **options: int) -> Tensor:
    """`conv2d` in the dtype of the image, under autocast too: bands are small differences."""
    with torch.autocast(image.device.type, enabled=False):
        return F.conv2d(image, kernel, **options)  # pyright: ignore


def _mirror(image: Tensor) -> Tensor:
    """Pads 2 pixels on every side, mirrored about the edge pixel (OpenCV's BORDER_REFLECT_101).

    torch's "reflect" refuses sides under 3. Mirrored repeatedly, a side of 2 is "circular", a side of 1 "replicate".
    """
    modes = [{1: "replicate", 2: "circular"}.get(side, "reflect") for side in image.shape[-2:]]
    if modes[0] == modes[1]:
        return F.pad(image, (2, 2, 2, 2), mode=modes[0])
    return F.pad(F.pad(image, (2, 2, 0, 0), mode=modes[1]), (0, 0, 2, 2), mode=modes[0])


def _kernel(image: Tensor) -> Tensor:
    """The 5x5 binomial kernel for a depthwise convolution of `image`, `[c 1 5 5]`, sum 1 per channel."""
    taps = torch.tensor(_TAPS, dtype=image.dtype, device=image.device) / 16
    return torch.outer(taps, taps).expand(image.shape[1], 1, 5, 5)
