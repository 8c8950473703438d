"""The spatial image term (Eq. 11): L1 and SSIM, with a compiled SSIM on CPU, and the clamping before it.

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
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.numba_threads import njit, prange

_TAPS = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
_STRIP = 32  # rows that one thread takes at a time: five blurred maps of a strip stay in the second-level cache

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
    pred: Float[Tensor, "b c h w"], target: Float[Tensor, "b c h w"], ssim_weight: float = 0.2
) -> Float[Tensor, ""]:
    """Eq. 11: (1 - ssim_weight) * mean |pred - target| + ssim_weight * (1 - SSIM); a part of weight 0 is not computed.

    Masked pixels: multiply both images by the mask first.
    """
    terms = []
    if ssim_weight != 1:
        terms.append((1 - ssim_weight) * (pred - target).abs().mean())
    if ssim_weight != 0:
        terms.append(ssim_weight * (1 - ssim(pred, target)))
    return torch.stack(terms).sum()


def ssim(pred: Float[Tensor, "b c h w"], target: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Mean structural similarity of images with values in [0, 1] (others are finite, but their SSIM means little).

    Equals pytorch_msssim's `ssim(data_range=1)` where both sides have 11 px or more. A shorter side shrinks the window
    along that axis to the largest odd size that fits, renormalised to sum 1; with one tap on both axes SSIM compares
    single colours.
    On CPU compiled loops compute value and gradient together, about 8 times as fast as convolutions with autograd.
    """
    if pred.shape != target.shape:
        raise ValueError(f"SSIM needs images of one size, got {tuple(pred.shape)} and {tuple(target.shape)}.")
    dtype = torch.float64 if pred.dtype == torch.float64 else torch.float32
    pred, target = pred.to(dtype), target.to(dtype)
    if pred.device.type != "cpu" or (pred.requires_grad and target.requires_grad):
        return _ssim_by_convolution(pred, target)
    if target.requires_grad:
        pred, target = target, pred
    height, width = pred.shape[-2:]
    rows, columns = _window(height), _window(width)
    # a shorter window is an 11-tap one with zeros around it, over an image with as many zeros around it
    edge = ((_TAPS - columns.size) // 2,) * 2 + ((_TAPS - rows.size) // 2,) * 2
    if any(edge):
        pred, target = F.pad(pred, edge), F.pad(target, edge)
    pred, target = pred.flatten(0, 1).contiguous(), target.flatten(0, 1).contiguous()
    padded = [np.pad(taps, (_TAPS - taps.size) // 2) for taps in (rows, columns)]
    return _CompiledSSIM.apply(pred, target, *padded)


@lru_cache(maxsize=16)
def _window(side: int) -> np.ndarray:
    """The normalised 1D Gaussian of the largest odd size up to 11 that fits into `side` pixels, float64."""
    size = min(_TAPS, side - 1 + side % 2)
    taps = np.exp(-0.5 * ((np.arange(size) - size // 2) / _SIGMA) ** 2)
    return taps / taps.sum()


def _ssim_by_convolution(x: Tensor, y: Tensor) -> Tensor:
    """SSIM in plain torch: any device, both gradients."""
    channels, height, width = x.shape[1:]
    rows, columns = (torch.as_tensor(_window(side), dtype=x.dtype, device=x.device) for side in (height, width))
    maps = torch.cat([x, y, x * x, y * y, x * y])
    maps = F.conv2d(maps, rows.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    maps = F.conv2d(maps, columns.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = maps.chunk(5)
    # rounding must not make a variance negative, or the denominator could vanish
    variances = (mean_xx - mean_x**2).clamp_min(0) + (mean_yy - mean_y**2).clamp_min(0)
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * (mean_xy - mean_x * mean_y) + _C2) / (variances + _C2)
    return (luminance * structure).mean()


class _CompiledSSIM(torch.autograd.Function):
    """SSIM of planes `[p h w]` with 11 taps per axis; the gradient for the first image is made in the forward pass."""

    @staticmethod
    def forward(ctx, x, y, rows, columns):
        x, y = x.detach(), y.detach()
        planes, height, width = x.shape
        rows, columns = (taps.astype(x.numpy().dtype) for taps in (rows, columns))
        inside = (planes, height - _TAPS + 1, width - _TAPS + 1)
        sums = np.zeros((planes, -(-inside[1] // _STRIP)))
        # derivatives by mean_x, mean_xx and mean_xy per window, with the zeros around that their blur backwards needs
        slopes = np.zeros((3, planes, height + _TAPS - 1, width + _TAPS - 1), rows.dtype)
        _similarity(x.numpy(), y.numpy(), rows, columns, sums, slopes)
        count = inside[0] * inside[1] * inside[2]
        if ctx.needs_input_grad[0]:
            gradient = torch.empty_like(x)
            _similarity_backward(x.numpy(), y.numpy(), rows, columns, slopes, gradient.numpy())
            ctx.save_for_backward(gradient.div_(count))
        return x.new_tensor(sums.sum() / count)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return ctx.saved_tensors[0] * upstream, None, None, None


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


@njit(fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity_of_row(x, y, xx, yy, xy, by_x, by_xx, by_xy, out):
    """SSIM of one row of windows from the five blurred maps, and its derivatives by the means of x, x^2 and x y."""
    scalar = x.dtype.type
    zero, one, two, c1, c2 = scalar(0), scalar(1), scalar(2), scalar(_C1), scalar(_C2)
    for j in range(x.size):
        a, b = x[j], y[j]
        per_luminance = one / (a * a + b * b + c1)
        per_variance = one / (max(xx[j] - a * a, zero) + max(yy[j] - b * b, zero) + c2)
        luminance = (two * a * b + c1) * per_luminance
        structure = (two * (xy[j] - a * b) + c2) * per_variance
        value = luminance * structure
        out[j] = value
        by_xy[j] = two * luminance * per_variance
        by_xx[j] = -value * per_variance
        by_x[j] = two * ((b * structure - a * value) * per_luminance + (a * value - b * luminance) * per_variance)


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity(x, y, rows, columns, sums, slopes):
    """Per strip of windows: blur every row of x, y, x^2, y^2, x y, then down the strip, then SSIM and derivatives."""
    planes, height, width = x.shape
    strips, wide, tall = sums.shape[1], width - 10, height - 10
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
        count = min(_STRIP, tall - top)
        blurred = np.empty((5, count + 10, wide), x.dtype)
        products = np.empty((3, width), x.dtype)
        maps = np.empty((6, wide), x.dtype)
        for i in range(count + 10):
            a, b = x[p, top + i], y[p, top + i]
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
            _similarity_of_row(maps[0], maps[1], maps[2], maps[3], maps[4], s[0], s[1], s[2], maps[5])
            sums[p, task % strips] += maps[5].sum()


@njit(parallel=True, fastmath={"contract"}, error_model="numpy", cache=True, nogil=True)
def _similarity_backward(x, y, rows, columns, slopes, out):
    """Blurs the three derivative maps back onto the pixels: d/dx = by_x + 2 x by_xx + y by_xy."""
    planes, height, width = x.shape
    strips, two = (height + _STRIP - 1) // _STRIP, x.dtype.type(2)
    for task in prange(planes * strips):
        p, top = task // strips, task % strips * _STRIP
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
                o[j] = maps[0, j] + two * a[j] * maps[1, j] + b[j] * maps[2, j]
