"""Colours from spherical harmonics up to degree 3 on the CPU in float32: `harmonics.level_colours`, compiled.

Used because torch's elementwise form makes two copies of all coefficients per step and direction.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.numba_threads import njit, prange

f4 = np.float32
_ZERO, _HALF, _ONE, _TWO, _FOUR, _SIX = f4(0), f4(0.5), f4(1), f4(2), f4(4), f4(6)
_C0, _C1 = f4(0.28209479177387814), f4(0.4886025119029199)
_C2 = tuple(f4(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
_C3 = tuple(
    f4(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
)


_BLOCK = 64
"""Gaussians whose directions and basis functions are computed together, in vectors"""
_X, _Y, _Z, _BASIS = 0, _BLOCK, 2 * _BLOCK, 3 * _BLOCK
"""where a block's directions and its basis functions 1..15 begin, `_BLOCK` numbers each (function 0 is constant)"""
_NUMBERS = _BASIS + 15 * _BLOCK


@njit(error_model="numpy", fastmath={"contract"}, cache=True, inline="always")
def _directions(offsets, first, count, out, inverse):
    """Unit directions and 1 / length; in double precision, as squares of far offsets overflow."""
    for j in range(count):
        x, y, z = (
            np.float64(offsets[first + j, 0]),
            np.float64(offsets[first + j, 1]),
            np.float64(offsets[first + j, 2]),
        )
        scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
        out[_X + j], out[_Y + j], out[_Z + j] = f4(x * scale), f4(y * scale), f4(z * scale)
        inverse[j] = scale


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _basis(degree, v):
    """The basis functions 1..15 behind a block's directions."""
    if degree > 0:
        for j in range(_BLOCK):
            v[_BASIS + j], v[_BASIS + _BLOCK + j] = -_C1 * v[_Y + j], _C1 * v[_Z + j]
            v[_BASIS + 2 * _BLOCK + j] = -_C1 * v[_X + j]
    if degree > 1:
        for j in range(_BLOCK):
            x, y, z = v[_X + j], v[_Y + j], v[_Z + j]
            xx, yy, zz = x * x, y * y, z * z
            v[_BASIS + 3 * _BLOCK + j], v[_BASIS + 4 * _BLOCK + j] = _C2[0] * x * y, -_C2[0] * y * z
            v[_BASIS + 5 * _BLOCK + j] = _C2[1] * (zz + zz - xx - yy)
            v[_BASIS + 6 * _BLOCK + j], v[_BASIS + 7 * _BLOCK + j] = -_C2[0] * x * z, _C2[2] * (xx - yy)
    if degree > 2:
        for j in range(_BLOCK):
            x, y, z = v[_X + j], v[_Y + j], v[_Z + j]
            xx, yy, zz = x * x, y * y, z * z
            four, three = _FOUR * zz - xx - yy, xx + xx + xx
            v[_BASIS + 8 * _BLOCK + j] = -_C3[0] * y * (three - yy)
            v[_BASIS + 9 * _BLOCK + j] = _C3[1] * x * y * z
            v[_BASIS + 10 * _BLOCK + j] = -_C3[2] * y * four
            v[_BASIS + 11 * _BLOCK + j] = _C3[3] * z * (zz + zz - three - yy - yy - yy)
            v[_BASIS + 12 * _BLOCK + j] = -_C3[2] * x * four
            v[_BASIS + 13 * _BLOCK + j] = _C3[4] * z * (xx - yy)
            v[_BASIS + 14 * _BLOCK + j] = -_C3[0] * x * (xx - yy - yy - yy)


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _gradient(degree, v, w, out):
    """Gradients by x, y and z, taken as independent, of sum_k w[k] basis_k for each of a block; `w` as `v`."""
    out[:] = _ZERO
    if degree > 0:
        for j in range(_BLOCK):
            w1, w2, w3 = w[_BASIS + j], w[_BASIS + _BLOCK + j], w[_BASIS + 2 * _BLOCK + j]
            out[_X + j], out[_Y + j], out[_Z + j] = -_C1 * w3, -_C1 * w1, _C1 * w2
    if degree > 1:
        a, b, c = _C2
        for j in range(_BLOCK):
            x, y, z = v[_X + j], v[_Y + j], v[_Z + j]
            w4, w5, w6 = w[_BASIS + 3 * _BLOCK + j], w[_BASIS + 4 * _BLOCK + j], w[_BASIS + 5 * _BLOCK + j]
            w7, w8 = w[_BASIS + 6 * _BLOCK + j], w[_BASIS + 7 * _BLOCK + j]
            out[_X + j] += a * (y * w4 - z * w7) + _TWO * x * (c * w8 - b * w6)
            out[_Y + j] += a * (x * w4 - z * w5) - _TWO * y * (c * w8 + b * w6)
            out[_Z + j] += -a * (y * w5 + x * w7) + _FOUR * b * z * w6
    if degree > 2:
        a, b, c, d, e = _C3
        for j in range(_BLOCK):
            x, y, z = v[_X + j], v[_Y + j], v[_Z + j]
            w9, w10, w11 = w[_BASIS + 8 * _BLOCK + j], w[_BASIS + 9 * _BLOCK + j], w[_BASIS + 10 * _BLOCK + j]
            w12, w13, w14 = w[_BASIS + 11 * _BLOCK + j], w[_BASIS + 12 * _BLOCK + j], w[_BASIS + 13 * _BLOCK + j]
            w15 = w[_BASIS + 14 * _BLOCK + j]
            xx, yy, zz = x * x, y * y, z * z
            across = a * (xx + xx + xx - yy - yy - yy)
            xy, xz, yz = x * y, x * z, y * z
            gx = -_SIX * a * xy * w9 + b * yz * w10 + _TWO * c * xy * w11 - _SIX * d * xz * w12
            gx += -c * (_FOUR * zz - xx - xx - xx - yy) * w13 + _TWO * e * xz * w14 - across * w15
            gy = -across * w9 + b * xz * w10 - c * (_FOUR * zz - xx - yy - yy - yy) * w11
            gy += -_SIX * d * yz * w12 + _TWO * c * xy * w13 - _TWO * e * yz * w14 + _SIX * a * xy * w15
            gz = b * xy * w10 - _FOUR * _TWO * c * (yz * w11 + xz * w13) + e * (xx - yy) * w14
            gz += d * (_SIX * zz - xx - xx - xx - yy - yy - yy) * w12
            out[_X + j] += gx
            out[_Y + j] += gy
            out[_Z + j] += gz


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _forward(dc, rest, offsets, level, signed, degree, out, passes):
    """Colours, and for each channel whether its gradient passes the clamp."""
    n, others = rest.shape[:2]
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        v, inverse = np.zeros(_NUMBERS, f4), np.empty(_BLOCK)
        first = block * _BLOCK
        count = min(_BLOCK, n - first)
        _directions(offsets, first, count, v, inverse)
        _basis(degree, v)
        for j in range(count):
            i = first + j
            r, g, b = _C0 * dc[i, 0], _C0 * dc[i, 1], _C0 * dc[i, 2]
            # two sums each: one addition need not wait for the other
            r2 = g2 = b2 = _ZERO
            for k in range(0, others - 1, 2):
                one, two = v[_BASIS + k * _BLOCK + j], v[_BASIS + (k + 1) * _BLOCK + j]
                r, r2 = r + one * rest[i, k, 0], r2 + two * rest[i, k + 1, 0]
                g, g2 = g + one * rest[i, k, 1], g2 + two * rest[i, k + 1, 1]
                b, b2 = b + one * rest[i, k, 2], b2 + two * rest[i, k + 1, 2]
            if others % 2 == 1:
                last, one = others - 1, v[_BASIS + (others - 1) * _BLOCK + j]
                r, g, b = r + one * rest[i, last, 0], g + one * rest[i, last, 1], b + one * rest[i, last, 2]
            colours = (r + r2 + _HALF, g + g2 + _HALF, b + b2 + _HALF)
            for channel in range(3):
                colour = colours[channel]
                # written so that NaN stays one
                passes[i, channel] = not (colour < _ZERO)
                if colour < _ZERO:
                    colour = _ZERO
                out[i, channel] = colour + colour - _ONE if signed and level[i] > 1 else colour


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def _backward(rest, offsets, level, signed, degree, passes, v_out, v_dc, v_rest, v_offsets):
    n, others = rest.shape[:2]
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        v, w = np.zeros(_NUMBERS, f4), np.zeros(_NUMBERS, f4)
        slope, inverse = np.empty(3 * _BLOCK, f4), np.empty(_BLOCK)
        first = block * _BLOCK
        count = min(_BLOCK, n - first)
        _directions(offsets, first, count, v, inverse)
        _basis(degree, v)
        for j in range(count):
            i = first + j
            gain = _TWO if signed and level[i] > 1 else _ONE
            r = gain * v_out[i, 0] if passes[i, 0] else _ZERO
            g = gain * v_out[i, 1] if passes[i, 1] else _ZERO
            b = gain * v_out[i, 2] if passes[i, 2] else _ZERO
            v_dc[i, 0], v_dc[i, 1], v_dc[i, 2] = _C0 * r, _C0 * g, _C0 * b
            if r == _ZERO and g == _ZERO and b == _ZERO:
                # not 0 times a coefficient, which may be infinite
                for k in range(others):
                    w[_BASIS + k * _BLOCK + j] = v_rest[i, k, 0] = v_rest[i, k, 1] = v_rest[i, k, 2] = _ZERO
                continue
            for k in range(others):
                basis = v[_BASIS + k * _BLOCK + j]
                w[_BASIS + k * _BLOCK + j] = r * rest[i, k, 0] + g * rest[i, k, 1] + b * rest[i, k, 2]
                v_rest[i, k, 0], v_rest[i, k, 1], v_rest[i, k, 2] = basis * r, basis * g, basis * b
        _gradient(degree, v, w, slope)
        for j in range(count):
            x, y, z = v[_X + j], v[_Y + j], v[_Z + j]
            gx, gy, gz = slope[_X + j], slope[_Y + j], slope[_Z + j]
            along = gx * x + gy * y + gz * z
            v_offsets[first + j, 0] = (gx - along * x) * inverse[j]
            v_offsets[first + j, 1] = (gy - along * y) * inverse[j]
            v_offsets[first + j, 2] = (gz - along * z) * inverse[j]


class CompiledColours(torch.autograd.Function):
    """(dc [n, 3], rest [n, k, 3], offsets [n, 3], level [n], signed) -> [n, 3]; see `harmonics.level_colours`."""

    @staticmethod
    def forward(ctx: Any, dc: Tensor, rest: Tensor, offsets: Tensor, level: Tensor, signed: bool) -> Tensor:
        dc, rest, offsets, level = (t.detach().contiguous() for t in (dc, rest, offsets, level))
        ctx.signed, ctx.degree = signed, math.isqrt(rest.shape[1] + 1) - 1
        out, passes = torch.empty_like(dc), torch.empty(dc.shape, dtype=torch.bool)
        _forward(*(t.numpy() for t in (dc, rest, offsets, level)), signed, ctx.degree, out.numpy(), passes.numpy())
        ctx.save_for_backward(rest, offsets, level, passes)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        rest, offsets, level, passes = ctx.saved_tensors
        v_dc, v_rest, v_offsets = torch.empty_like(offsets), torch.empty_like(rest), torch.empty_like(offsets)
        arrays = (t.numpy() for t in (passes, upstream.contiguous(), v_dc, v_rest, v_offsets))
        _backward(rest.numpy(), offsets.numpy(), level.numpy(), ctx.signed, ctx.degree, *arrays)
        return v_dc, v_rest, v_offsets, None, None
