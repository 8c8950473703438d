"""Spherical harmonics up to degree 3 on the CPU in float32: the same as `harmonics.evaluate`, compiled.

Used because torch's elementwise form makes two copies of all coefficients per step and direction.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from freqgs_plugin.functional.numba_threads import njit, prange

COMPILED_DEGREE = 3
_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _direction(offsets, i):
    x, y, z = np.float64(offsets[i, 0]), np.float64(offsets[i, 1]), np.float64(offsets[i, 2])
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length, length


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _basis(x, y, z, degree, out):
    out[0] = _C0
    if degree > 0:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out[4], out[5], out[7] = _C2[0] * x * y, -_C2[0] * y * z, -_C2[0] * x * z
        out[6], out[8] = _C2[1] * (2 * zz - xx - yy), _C2[2] * (xx - yy)
        if degree > 2:
            out[9], out[15] = -_C3[0] * y * (3 * xx - yy), -_C3[0] * x * (xx - 3 * yy)
            out[10], out[14] = _C3[1] * x * y * z, _C3[4] * z * (xx - yy)
            out[11], out[13] = -_C3[2] * y * (4 * zz - xx - yy), -_C3[2] * x * (4 * zz - xx - yy)
            out[12] = _C3[3] * z * (2 * zz - 3 * xx - 3 * yy)


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _gradient(x, y, z, degree, w):
    """Gradient of sum_k w[k] basis_k with respect to x, y and z, taken as independent."""
    gx = gy = gz = 0.0
    if degree > 0:
        gx, gy, gz = -_C1 * w[3], -_C1 * w[1], _C1 * w[2]
    if degree > 1:
        a, b, c = _C2
        gx += a * (y * w[4] - z * w[7]) - 2 * b * x * w[6] + 2 * c * x * w[8]
        gy += a * (x * w[4] - z * w[5]) - 2 * b * y * w[6] - 2 * c * y * w[8]
        gz += -a * (y * w[5] + x * w[7]) + 4 * b * z * w[6]
    if degree > 2:
        a, b, c, d, e = _C3
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * a * x * y * w[9] + b * y * z * w[10] + 2 * c * x * y * w[11] - 6 * d * x * z * w[12]
        gx += -c * (4 * zz - 3 * xx - yy) * w[13] + 2 * e * x * z * w[14] - 3 * a * (xx - yy) * w[15]
        gy += -3 * a * (xx - yy) * w[9] + b * x * z * w[10] - c * (4 * zz - xx - 3 * yy) * w[11]
        gy += -6 * d * y * z * w[12] + 2 * c * x * y * w[13] - 2 * e * y * z * w[14] + 6 * a * x * y * w[15]
        gz += b * x * y * w[10] - 8 * c * y * z * w[11] + d * (6 * zz - 3 * xx - 3 * yy) * w[12]
        gz += -8 * c * x * z * w[13] + e * (xx - yy) * w[14]
    return gx, gy, gz


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _forward(sh, offsets, degree, out):
    coefficients = (degree + 1) ** 2
    for i in prange(sh.shape[0]):
        basis = np.empty(16)
        x, y, z, _ = _direction(offsets, i)
        _basis(x, y, z, degree, basis)
        r = g = b = 0.0
        for k in range(coefficients):
            r += basis[k] * sh[i, k, 0]
            g += basis[k] * sh[i, k, 1]
            b += basis[k] * sh[i, k, 2]
        out[i, 0], out[i, 1], out[i, 2] = r, g, b


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _backward(sh, offsets, degree, v_out, v_sh, v_offsets):
    coefficients = (degree + 1) ** 2
    for i in prange(sh.shape[0]):
        r, g, b = v_out[i, 0], v_out[i, 1], v_out[i, 2]
        if r == 0 and g == 0 and b == 0:
            for k in range(coefficients):
                v_sh[i, k, 0], v_sh[i, k, 1], v_sh[i, k, 2] = 0.0, 0.0, 0.0
            v_offsets[i, 0], v_offsets[i, 1], v_offsets[i, 2] = 0.0, 0.0, 0.0
            continue
        basis = np.empty(16)
        weight = np.empty(16)
        x, y, z, length = _direction(offsets, i)
        _basis(x, y, z, degree, basis)
        for k in range(coefficients):
            weight[k] = r * sh[i, k, 0] + g * sh[i, k, 1] + b * sh[i, k, 2]
            v_sh[i, k, 0], v_sh[i, k, 1], v_sh[i, k, 2] = basis[k] * r, basis[k] * g, basis[k] * b
        gx, gy, gz = _gradient(x, y, z, degree, weight)
        along = gx * x + gy * y + gz * z
        v_offsets[i, 0] = (gx - along * x) / length
        v_offsets[i, 1] = (gy - along * y) / length
        v_offsets[i, 2] = (gz - along * z) / length


class CompiledHarmonics(torch.autograd.Function):
    """(sh [n, k, 3], offsets [n, 3]) -> [n, 3]; see `harmonics.evaluate`."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, offsets: Tensor) -> Tensor:
        sh, offsets = sh.contiguous(), offsets.contiguous()
        ctx.save_for_backward(sh, offsets)
        ctx.degree = math.isqrt(sh.shape[1]) - 1
        out = torch.empty(len(sh), 3)
        _forward(sh.detach().numpy(), offsets.detach().numpy(), ctx.degree, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        sh, offsets = ctx.saved_tensors
        v_sh, v_offsets = torch.empty_like(sh), torch.empty_like(offsets)
        arrays = (t.detach().numpy() for t in (grads[0].contiguous(), v_sh, v_offsets))
        _backward(sh.detach().numpy(), offsets.detach().numpy(), ctx.degree, *arrays)
        return v_sh, v_offsets
