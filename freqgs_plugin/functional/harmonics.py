"""Real spherical harmonics up to degree 4, in the sign convention of 3D Gaussian splatting, and colours from them."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.projection import working_dtype

MAX_DEGREE = 4
C0 = 0.28209479177387814
"""the constant basis function, sqrt(1 / 4 pi)"""


def num_coefficients(degree: int) -> int:
    """Coefficients per channel of harmonics up to `degree`."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"SH degree {degree} is outside of 0..{MAX_DEGREE}.")
    return (degree + 1) ** 2


def basis(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """Basis functions at unit `directions` (camera to Gaussian, world axes), k = (degree + 1)^2."""
    num_coefficients(degree)
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    out = [torch.full_like(x, C0)]
    if degree > 0:
        out += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        out += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        out += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    if degree > 3:
        out += [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return torch.stack(out, -1)


def evaluate(
    dc: Float[Tensor, "n 3"], rest: Float[Tensor, "n k 3"], offsets: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Harmonics in the direction of `offsets` (any length; at length 0 the direction is 0).

    `dc` is the coefficient of degree 0, `rest` are the (degree + 1)^2 - 1 others.
    """
    # squares of far offsets overflow in float32
    directions = torch.nn.functional.normalize(offsets.to(working_dtype(offsets)), dim=-1).to(offsets)
    # of degree 0 the sum is 0, and gives a parameter that `rest` is a slice of its gradient, 0: optimizers count its
    # steps from there
    return C0 * dc + (basis(directions, _degree(rest))[:, 1:, None] * rest).sum(1)


def _degree(rest: Float[Tensor, "n k 3"]) -> int:
    return math.isqrt(rest.shape[1] + 1) - 1


def level_colours(
    dc: Float[Tensor, "n 3"],
    rest: Float[Tensor, "n k 3"],
    offsets: Float[Tensor, "n 3"],
    level: Int[Tensor, " n"],
    signed_residuals: bool,
) -> Float[Tensor, "n 3"]:
    """Colours of the Laplacian-pyramid paper: clamp_min(SH + 0.5, 0) (Eq. 3); above level 1 twice that minus 1 (Eq. 4).

    `dc`, `rest` and `offsets` as for `evaluate`. With `signed_residuals` False, Eq. 3 for every level. Eq. 4's range is
    [-1, inf): the paper names [-1, 1], its code does not clamp from above.
    """
    on_cpu = dc.device.type == "cpu" and dc.dtype == rest.dtype == offsets.dtype == torch.float32
    if on_cpu and not level.is_floating_point() and _degree(rest) <= 3:
        from freqgs_plugin.functional.compiled_harmonics import CompiledColours

        return CompiledColours.apply(dc, rest, offsets, level, signed_residuals)  # pyright: ignore[reportReturnType]
    return level_colours_in_torch(dc, rest, offsets, level, signed_residuals)


def level_colours_in_torch(
    dc: Float[Tensor, "n 3"],
    rest: Float[Tensor, "n k 3"],
    offsets: Float[Tensor, "n 3"],
    level: Int[Tensor, " n"],
    signed_residuals: bool,
) -> Float[Tensor, "n 3"]:
    """`level_colours` on any device and in any dtype."""
    colour = torch.clamp_min(evaluate(dc, rest, offsets) + 0.5, 0.0)
    if not signed_residuals:
        return colour
    residual = (level > 1)[:, None].to(colour.dtype)
    return colour * (1 + residual) - residual
