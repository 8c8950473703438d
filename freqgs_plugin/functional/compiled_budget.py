"""What budgets look at for every Gaussian of a view, on the CPU in float32: the same as in `budget`, compiled.

Used because a budget is kept at every picture, and selecting rows takes torch longer than all of the arithmetic.
"""

import math

import numpy as np
import torch
from torch import Tensor

from freqgs_plugin.functional.attenuation import EPSILON, TAU
from freqgs_plugin.functional.numba_threads import njit
from freqgs_plugin.functional.projection import FOV_MARGIN, NEAR_PLANE, RADIUS_SIGMAS
from freqgs_plugin.types import Camera, Gaussians


@njit(error_model="numpy", nogil=True, cache=True)
def _in_view(means, scales, view, intrinsics, width, height, slack, out):
    fx, fy, cx, cy = intrinsics
    low_u, high_u = (-cx - FOV_MARGIN * width) / fx, (width - cx + FOV_MARGIN * width) / fx
    low_v, high_v = (-cy - FOV_MARGIN * height) / fy, (height - cy + FOV_MARGIN * height) / fy
    focal = max(fx, fy)
    for i in range(len(means)):
        m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = view[2, 0] * m0 + view[2, 1] * m1 + view[2, 2] * m2 + view[2, 3]
        out[i] = False
        if not z > NEAR_PLANE:
            continue
        u = (view[0, 0] * m0 + view[0, 1] * m1 + view[0, 2] * m2 + view[0, 3]) / z
        v = (view[1, 0] * m0 + view[1, 1] * m1 + view[1, 2] * m2 + view[1, 3]) / z
        x, y = u * fx + cx, v * fy + cy
        # a radius is not negative: most of what is in view needs none
        if 0 < x < width and 0 < y < height:
            out[i] = True
            continue
        held_u, held_v = min(max(u, low_u), high_u), min(max(v, low_v), high_v)
        size = np.float64(max(scales[i, 0], scales[i, 1], scales[i, 2])) * focal / z
        radius = math.ceil(RADIUS_SIGMAS * math.sqrt(size * size * (1 + held_u * held_u + held_v * held_v) + slack))
        out[i] = x + radius > 0 and x - radius < width and y + radius > 0 and y - radius < height


@njit(error_model="numpy", nogil=True, cache=True)
def _exponents(opacities, distance, decay, seen, log_scale, a, b):
    log_tau, factor, n = math.log(TAU), math.exp(2 * log_scale), 0
    for i in range(len(seen)):
        if seen[i] and opacities[i] > 0:
            sigma, d = max(np.float64(decay[i]), 0.0), np.float64(distance[i])
            a[n] = d * d / (2 * sigma * sigma + EPSILON)
            b[n] = math.log(np.float64(opacities[i])) - log_tau
            n += b[n] - a[n] * factor > log_scale
    return n


@njit(error_model="numpy", nogil=True, cache=True)
def _count_above(a, b, factor, log_scale):
    n = 0
    for i in range(len(a)):
        n += b[i] - a[i] * factor > log_scale
    return n


@njit(error_model="numpy", nogil=True, cache=True)
def _between(a, b, low_factor, low, high_factor, high, out):
    n = 0
    for i in range(len(a)):
        out[n] = i
        n += b[i] - a[i] * low_factor > low and b[i] - a[i] * high_factor <= high
    return n


def in_view(gaussians: Gaussians, camera: Camera, slack: float) -> Tensor:
    """`budget.in_view` for float32 tensors on the CPU."""
    intrinsics = camera.K.detach().double()
    seen = np.empty(len(gaussians), dtype=np.bool_)
    _in_view(
        gaussians.means.detach().numpy(),
        gaussians.scales.detach().numpy(),
        camera.viewmat.detach().double().numpy(),
        tuple(float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))),
        float(camera.width),
        float(camera.height),
        slack,
        seen,
    )
    return torch.from_numpy(seen)


def exponents(
    opacities: Tensor, distance: Tensor, decay: Tensor, seen: Tensor, log_scale: float
) -> tuple[Tensor, Tensor]:
    """ln s* as its equation, for the rows in view where it is above `log_scale`; float32 tensors on the CPU."""
    a, b = np.empty(len(seen) + 1), np.empty(len(seen) + 1)
    n = _exponents(opacities.detach().numpy(), distance.numpy(), decay.detach().numpy(), seen.numpy(), log_scale, a, b)
    return torch.from_numpy(a[:n]), torch.from_numpy(b[:n])


def count_above(a: Tensor, b: Tensor, log_scale: float) -> int:
    """How many have b - a e^(2 log_scale) > log_scale, for float64 tensors on the CPU."""
    return _count_above(a.numpy(), b.numpy(), math.exp(2 * log_scale), log_scale)


def between(a: Tensor, b: Tensor, low: float, high: float) -> Tensor:
    """Rows above `low` and not above `high`, as `count_above` has it."""
    rows = np.empty(len(a) + 1, dtype=np.int64)
    n = _between(a.numpy(), b.numpy(), math.exp(2 * low), low, math.exp(2 * high), high, rows)
    return torch.from_numpy(rows[:n])
