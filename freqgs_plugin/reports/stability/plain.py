"""The truth for losses: definitions written out with dense matrices and windows, in float64, by plain autograd."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.image_loss import C1, C2, TAPS


def dft(image: Float[Tensor, "b c h w"]) -> Tensor:
    """The unnormalised DFT, complex [b, c, h, w], as a product with two matrices."""

    def matrix(size: int) -> Tensor:
        k = torch.arange(size, dtype=torch.float64)
        # the product of indices is reduced first: sines of large angles lose digits
        angle = 2 * torch.pi * ((k[:, None] * k[None]) % size) / size
        return torch.polar(torch.ones_like(angle), -angle)

    return matrix(image.shape[-2]) @ image.to(torch.complex128) @ matrix(image.shape[-1])


def dft_distance(pred: Float[Tensor, "b c h w"], target: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Mean over all frequencies of | |F(pred)| - |F(target)| |."""
    return (dft(pred).abs() - dft(target).abs()).abs().mean()


def ssim(x: Float[Tensor, "b c h w"], y: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Mean over all windows inside of the image; variances as sums of squared differences from the window's mean."""

    def taps(side: int) -> Tensor:
        size = min(TAPS, side - 1 + side % 2)
        bell = torch.exp(-0.5 * ((torch.arange(size, dtype=torch.float64) - size // 2) / 1.5) ** 2)
        return bell / bell.sum()

    rows, columns = taps(x.shape[-2]), taps(x.shape[-1])
    weight = rows[:, None] * columns[None]

    def windows(image: Tensor) -> Tensor:
        return image.unfold(-2, len(rows), 1).unfold(-2, len(columns), 1)

    def mean(values: Tensor) -> Tensor:
        return (values * weight).sum((-2, -1))

    wx, wy = windows(x), windows(y)
    a, b = mean(wx), mean(wy)
    dx, dy = wx - a[..., None, None], wy - b[..., None, None]
    luminance = (2 * a * b + C1) / (a * a + b * b + C1)
    structure = (2 * mean(dx * dy) + C2) / (mean(dx * dx) + mean(dy * dy) + C2)
    return (luminance * structure).mean()


def _sampling(size: int) -> Tensor:
    """REDUCE along one axis as a matrix [ceil(size / 2), size]: [1, 4, 6, 4, 1] / 16 around 2i, edges mirrored."""
    matrix = torch.zeros((size + 1) // 2, size, dtype=torch.float64)
    for i in range(matrix.shape[0]):
        for offset, tap in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True):
            matrix[i, _mirrored(2 * i + offset, size)] += tap / 16
    return matrix


def _mirrored(index: int, size: int) -> int:
    if size == 1:
        return 0
    index %= 2 * (size - 1)
    return min(index, 2 * (size - 1) - index)


def reduce(image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    """REDUCE of Burt and Adelson."""
    return _sampling(image.shape[-2]) @ image @ _sampling(image.shape[-1]).T


def low_pass(image: Float[Tensor, "b c h w"], times: int) -> Float[Tensor, "b c h w"]:
    """Means of pairs `times` times, then bilinear doubling back; an odd side loses its last row and repeats one."""
    return _round_trip(image.shape[-2], times) @ image @ _round_trip(image.shape[-1], times).T


def _round_trip(size: int, times: int) -> Tensor:
    if times == 0:
        return torch.eye(size, dtype=torch.float64)
    half = max(size // 2, 1)
    down = np.zeros((half, size))
    up = np.zeros((size, half))
    for i in range(half):
        down[i, [2 * i, min(2 * i + 1, size - 1)]] += 0.5
    for i in range(size):
        # the last row of an odd side is the one before it again
        i_even = min(i, 2 * half - 1)
        near = i_even // 2
        other = near - 1 if i_even % 2 == 0 else near + 1
        up[i, near] += 0.75
        up[i, min(max(other, 0), half - 1)] += 0.25
    if size == 1:
        return torch.eye(1, dtype=torch.float64)
    return torch.as_tensor(up) @ _round_trip(half, times - 1) @ torch.as_tensor(down)
