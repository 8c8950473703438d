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
f4 = np.float32
_ZERO, _TWO, _FOUR, _SIX = f4(0), f4(2), f4(4), f4(6)
_C0, _C1 = f4(0.28209479177387814), f4(0.4886025119029199)
_C2 = tuple(f4(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
_C3 = tuple(
    f4(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
)


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _direction(offsets, i):
    """Unit direction and 1 / length; in double precision, as squares of far offsets overflow."""
    x, y, z = np.float64(offsets[i, 0]), np.float64(offsets[i, 1]), np.float64(offsets[i, 2])
    inverse = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return f4(x * inverse), f4(y * inverse), f4(z * inverse), inverse


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _basis(x, y, z, degree, out):
    out[0] = _C0
    if degree > 0:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out[4], out[5], out[7] = _C2[0] * x * y, -_C2[0] * y * z, -_C2[0] * x * z
        out[6], out[8] = _C2[1] * (zz + zz - xx - yy), _C2[2] * (xx - yy)
        if degree > 2:
            four, three = _FOUR * zz - xx - yy, xx + xx + xx
            out[9], out[15] = -_C3[0] * y * (three - yy), -_C3[0] * x * (xx - yy - yy - yy)
            out[10], out[14] = _C3[1] * x * y * z, _C3[4] * z * (xx - yy)
            out[11], out[13] = -_C3[2] * y * four, -_C3[2] * x * four
            out[12] = _C3[3] * z * (zz + zz - three - yy - yy - yy)


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _gradient(x, y, z, degree, w):
    """Gradient of sum_k w[k] basis_k with respect to x, y and z, taken as independent."""
    gx = gy = gz = _ZERO
    if degree > 0:
        gx, gy, gz = -_C1 * w[3], -_C1 * w[1], _C1 * w[2]
    if degree > 1:
        a, b, c = _C2
        gx += a * (y * w[4] - z * w[7]) + _TWO * x * (c * w[8] - b * w[6])
        gy += a * (x * w[4] - z * w[5]) - _TWO * y * (c * w[8] + b * w[6])
        gz += -a * (y * w[5] + x * w[7]) + _FOUR * b * z * w[6]
    if degree > 2:
        a, b, c, d, e = _C3
        xx, yy, zz = x * x, y * y, z * z
        across = a * (xx + xx + xx - yy - yy - yy)
        xy, xz, yz = x * y, x * z, y * z
        gx += -_SIX * a * xy * w[9] + b * yz * w[10] + _TWO * c * xy * w[11] - _SIX * d * xz * w[12]
        gx += -c * (_FOUR * zz - xx - xx - xx - yy) * w[13] + _TWO * e * xz * w[14] - across * w[15]
        gy += -across * w[9] + b * xz * w[10] - c * (_FOUR * zz - xx - yy - yy - yy) * w[11]
        gy += -_SIX * d * yz * w[12] + _TWO * c * xy * w[13] - _TWO * e * yz * w[14] + _SIX * a * xy * w[15]
        gz += b * xy * w[10] - _FOUR * _TWO * c * (yz * w[11] + xz * w[13]) + e * (xx - yy) * w[14]
        gz += d * (_SIX * zz - xx - xx - xx - yy - yy - yy) * w[12]
    return gx, gy, gz


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _forward(dc, rest, offsets, degree, out):
    for i in prange(dc.shape[0]):
        basis = np.empty(16, f4)
        x, y, z, _ = _direction(offsets, i)
        _basis(x, y, z, degree, basis)
        r, g, b = _C0 * dc[i, 0], _C0 * dc[i, 1], _C0 * dc[i, 2]
        for k in range(rest.shape[1]):
            r += basis[k + 1] * rest[i, k, 0]
            g += basis[k + 1] * rest[i, k, 1]
            b += basis[k + 1] * rest[i, k, 2]
        out[i, 0], out[i, 1], out[i, 2] = r, g, b


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _backward(rest, offsets, degree, v_out, v_dc, v_rest, v_offsets):
    for i in prange(rest.shape[0]):
        r, g, b = v_out[i, 0], v_out[i, 1], v_out[i, 2]
        v_dc[i, 0], v_dc[i, 1], v_dc[i, 2] = _C0 * r, _C0 * g, _C0 * b
        if r == _ZERO and g == _ZERO and b == _ZERO:
            v_rest[i] = _ZERO
            v_offsets[i] = _ZERO
            continue
        basis = np.empty(16, f4)
        weight = np.empty(16, f4)
        x, y, z, inverse = _direction(offsets, i)
        _basis(x, y, z, degree, basis)
        for k in range(rest.shape[1]):
            weight[k + 1] = r * rest[i, k, 0] + g * rest[i, k, 1] + b * rest[i, k, 2]
            v_rest[i, k, 0], v_rest[i, k, 1], v_rest[i, k, 2] = basis[k + 1] * r, basis[k + 1] * g, basis[k + 1] * b
        gx, gy, gz = _gradient(x, y, z, degree, weight)
        along = gx * x + gy * y + gz * z
        v_offsets[i, 0] = (gx - along * x) * inverse
        v_offsets[i, 1] = (gy - along * y) * inverse
        v_offsets[i, 2] = (gz - along * z) * inverse


class CompiledHarmonics(torch.autograd.Function):
    """(dc [n, 3], rest [n, k, 3], offsets [n, 3]) -> [n, 3]; see `harmonics.evaluate`."""

    @staticmethod
    def forward(ctx: Any, dc: Tensor, rest: Tensor, offsets: Tensor) -> Tensor:
        dc, rest, offsets = dc.contiguous(), rest.contiguous(), offsets.contiguous()
        ctx.save_for_backward(rest, offsets)
        ctx.degree = math.isqrt(rest.shape[1] + 1) - 1
        out = torch.empty_like(dc)
        _forward(*(t.detach().numpy() for t in (dc, rest, offsets)), ctx.degree, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rest, offsets = ctx.saved_tensors
        v_dc, v_rest, v_offsets = torch.empty_like(offsets), torch.empty_like(rest), torch.empty_like(offsets)
        arrays = (t.detach().numpy() for t in (grads[0].contiguous(), v_dc, v_rest, v_offsets))
        _backward(rest.detach().numpy(), offsets.detach().numpy(), ctx.degree, *arrays)
        return v_dc, v_rest, v_offsets
