"""The spatial image term (Eq. 11): L1 and SSIM, compiled on CPU, and the clamping before it.

SSIM here is pytorch_msssim's, which splatfacto trains with: values in [0, 1], an 11x11 Gaussian window of standard
deviation 1.5 px, only windows that lie inside the image, K = (0.01, 0.03), mean over everything. kornia's loss is
(1 - SSIM) / 2 on the padded image, so it is not the same number.
"""

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

TAPS = 11
_SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2

Clamp = Literal["none", "hard", "straight_through"]


def prepare(pred: Float[Tensor, "*shape"], mode: Clamp) -> Float[Tensor, "*shape"]:
    """The prediction as the loss sees it. Sums of signed residuals leave [0, 1], where the modes differ:

    - `"none"`: unchanged, so the loss also pulls back what a viewer would clamp;
    - `"hard"`: clamped to [0, 1], gradient 0 outside (the paper's public code); at exactly 0 and 1 it
      depends on torch's version;
    - `"straight_through"`: clamped to [0, 1], gradient 1 everywhere.
    """
    if mode == "none":
        return pred
    if mode == "hard":
        return pred.clamp(0, 1)
    if mode == "straight_through":
        return pred.detach().clamp(0, 1) + (pred - pred.detach())
    raise ValueError(f'unknown clamp mode {mode!r}. Use "none", "hard" or "straight_through".')


def image_distance(
    pred: Float[Tensor, "b c h w"],
    target: Float[Tensor, "b c h w"],
    ssim_weight: float | int = 0.2,
    weight: float | int = 1.0,
) -> Float[Tensor, ""]:
    """Eq. 11: (1 - ssim_weight) * mean |pred - target| + ssim_weight * (1 - SSIM), times `weight`.

    A part of weight 0 is not computed. On CPU a factor on the result would cost a pass over the gradient, `weight` does
    not. Masked pixels: multiply both images by the mask first.
    """
    if ssim_weight == 0:
        return weight * _mean_distance(pred, target)
    pred, target = _comparable(pred, target)
    if not _has_kernels(pred, target):
        similarity = _ssim_by_convolution(pred, target)
        return weight * ((1 - ssim_weight) * _mean_distance(pred, target) + ssim_weight * (1 - similarity))
    by_l1, by_ssim = weight * (1 - ssim_weight) / pred.numel(), -weight * ssim_weight / windows(pred)
    return weight * ssim_weight + _compiled_sums(pred, target, by_ssim, by_l1)


def ssim(pred: Float[Tensor, "b c h w"], target: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Mean structural similarity of images with values in [0, 1] (others are finite, but their SSIM means little).

    Equals pytorch_msssim's `ssim(data_range=1)` where both sides have 11 px or more. A shorter side shrinks the window
    along that axis to the largest odd size that fits, renormalised to sum 1; with one tap on both axes SSIM compares
    single colours.
    On CPU compiled loops compute value and gradient together, over 20 times as fast as convolutions with autograd
    (3 planes of 320x480, one thread).
    """
    pred, target = _comparable(pred, target)
    if not _has_kernels(pred, target):
        return _ssim_by_convolution(pred, target)
    return _compiled_sums(pred, target, 1 / windows(pred), 0.0)


def mean_square_as_shown(picture: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean of (clamp(picture, 0, 1) - target)^2, without gradient."""
    picture, target = picture.detach(), target.detach()
    same = picture.dtype == target.dtype and picture.dtype in (torch.float32, torch.float64)
    if picture.device.type == "cpu" and same and picture.shape == target.shape:
        from freqgs_plugin.functional.compiled_image_loss import squared_error_as_shown

        planes = (image.permute(2, 0, 1).contiguous() for image in (picture, target))
        return picture.new_tensor(squared_error_as_shown(*planes) / max(picture.numel(), 1))
    return (picture.clamp(0, 1) - target).square().mean()


def _mean_distance(pred: Tensor, target: Tensor) -> Tensor:
    # row by row: the sum over everything would have other last bits with another number of threads
    return (pred - target).abs().mean(-1).mean()


def _comparable(pred: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both in the same precision, at least float32; the one with a gradient first, as both measures are symmetric."""
    if pred.shape != target.shape:
        raise ValueError(f"SSIM needs images of one size, got {tuple(pred.shape)} and {tuple(target.shape)}.")
    dtype = torch.float64 if pred.dtype == torch.float64 else torch.float32
    pred, target = pred.to(dtype), target.to(dtype)
    return (target, pred) if target.requires_grad and not pred.requires_grad else (pred, target)


def _has_kernels(pred: Tensor, target: Tensor) -> bool:
    return pred.device.type == "cpu" and not target.requires_grad


def windows(image: Tensor) -> int:
    """How many windows SSIM is the mean over."""
    height, width = image.shape[-2:]
    return image.shape[:-2].numel() * (height - window(height).size + 1) * (width - window(width).size + 1)


def _compiled_sums(pred: Tensor, target: Tensor, by_ssim: float, by_l1: float) -> Tensor:
    """`by_ssim` times the sum of SSIM over all windows and `by_l1` times that of |pred - target|, by compiled loops."""
    from freqgs_plugin.functional.compiled_image_loss import CompiledImageSums

    height, width = pred.shape[-2:]
    rows, columns = window(height), window(width)
    # a shorter window is an 11-tap one with zeros around it, over an image with as many zeros around it
    pixels = height * width
    edge = ((TAPS - columns.size) // 2,) * 2 + ((TAPS - rows.size) // 2,) * 2
    if any(edge):
        pred, target = F.pad(pred, edge), F.pad(target, edge)
    pred, target = pred.flatten(0, 1).contiguous(), target.flatten(0, 1).contiguous()
    padded = [np.pad(taps, (TAPS - taps.size) // 2) for taps in (rows, columns)]
    return CompiledImageSums.apply(pred, target, *padded, pixels, by_ssim, by_l1)


def _plane_means(image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c 1 1"]:
    """What is subtracted from images before SSIM: variances of bright flat ones are differences of large squares.

    The mean of each plane, without gradient; row by row, so that threads do not change its bits.
    """
    return image.detach().mean(-1, keepdim=True).mean(-2, keepdim=True)


@lru_cache(maxsize=16)
def window(side: int) -> np.ndarray:
    """The normalised 1D Gaussian of the largest odd size up to 11 that fits into `side` pixels, float64."""
    size = min(TAPS, side - 1 + side % 2)
    taps = np.exp(-0.5 * ((np.arange(size) - size // 2) / _SIGMA) ** 2)
    return taps / taps.sum()


@lru_cache(maxsize=16)
def _window_on(side: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`window` as a tensor; kept, because a copy to a CUDA device waits for it."""
    return torch.as_tensor(window(side), dtype=dtype, device=device)


def _ssim_by_convolution(x: Tensor, y: Tensor) -> Tensor:
    """SSIM in plain torch: any device, both gradients."""
    from kornia.filters import filter2d_separable

    height, width = x.shape[2:]
    centre_x, centre_y = _plane_means(x), _plane_means(y)
    x, y = x - centre_x, y - centre_y
    rows, columns = (_window_on(side, x.dtype, x.device) for side in (height, width))
    # variances are differences of blurred squares: half precision would leave nothing of them
    with torch.autocast(x.device.type, enabled=False):
        maps = filter2d_separable(torch.cat([x, y, x * x + y * y, x * y]), columns[None], rows[None], padding="valid")
    mean_x, mean_y, squares, mean_xy = maps.chunk(4)
    # rounding must not make the variances negative, or the denominator could vanish
    variances = (squares - mean_x**2 - mean_y**2).clamp_min(0)
    structure = (2 * (mean_xy - mean_x * mean_y) + C2) / (variances + C2)
    mean_x, mean_y = mean_x + centre_x, mean_y + centre_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return (luminance * structure).mean()
