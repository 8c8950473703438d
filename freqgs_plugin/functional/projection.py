"""Perspective projection of 3D Gaussians to 2D ones: EWA splatting as in gsplat's `fully_fused_projection`.

Everything is elementwise on unbound components: batches of 3x3 products are slow on a CPU, and autocast would take them
in half precision. The determinant of the projected covariance is a cross product, because `a c - b^2` loses every digit
for needle-shaped Gaussians. Whatever the dtype, the arithmetic is in float64, as in the compiled kernels. That is a
twentieth of a picture's time; in float32, scenes far from the origin lose their digits, and gradients by scales above
1e5 px are wrong, because the squared determinant underflows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from freqgs_plugin.types import Camera

NEAR_PLANE = 0.01
"""camera z at or below this is culled, world units; `rendering.base` names the same number"""
FOV_MARGIN = 0.15
"""the Jacobian is taken at most this share of the image size outside of the image"""
RADIUS_SIGMAS = 3.0
"""the radius is this many standard deviations of the longer axis"""
STD_MAX = 1e8
"""scales are limited to about this many pixels on the image plane: beyond, conics underflow in float32"""
QUATERNION_MIN = 1e-20
"""a quaternion with no component above this has no direction and counts as the identity"""


@dataclass(frozen=True)
class Projected:
    """2D Gaussians on the image plane of one camera."""

    means2d: Float[Tensor, "n 2"]
    """px, pixel centres at +0.5"""
    conics: Float[Tensor, "n 3"]
    """a, b, c of the inverse covariance [[a, b], [b, c]] (with blur), px^-2; in float64 where the device has it: the
    gradient by a needle's length is a small difference of theirs"""
    depths: Float[Tensor, " n"]
    """camera z, world units"""
    cov_xx: Float[Tensor, " n"]
    """variance along x (with blur), px^2; no gradient"""
    cov_yy: Float[Tensor, " n"]
    """variance along y (with blur), px^2; no gradient"""
    compensation: Float[Tensor, " n"]
    """sqrt(det(cov) / det(cov + blur)), in [0, 1]: Mip-Splatting's factor on the opacity"""
    radii: Int32[Tensor, " n"]
    """px, 3 standard deviations of the longer axis rounded up; 0 for what is culled"""
    visible: Bool[Tensor, " n"]
    """in front of the near plane and within `radii` of the image; nothing else is drawn"""


def rotation_rows(quats: Float[Tensor, "n 4"]) -> list[list[Float[Tensor, " n"]]]:
    """The 3x3 rotation matrix of each quaternion (wxyz, any norm), as nested lists of its entries.

    Invariant to the norm down to 1e-20. A zero quaternion gives the identity, with zero gradient.
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)
    defined = largest > QUATERNION_MIN
    scaled = torch.where(defined, quats, 0.0) / torch.where(defined, largest, 1.0)
    squared = scaled.square().sum(dim=-1, keepdim=True)
    w, x, y, z = (scaled / torch.where(defined, squared, 1.0).sqrt()).unbind(-1)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def exact_centre(camera: Camera) -> Float[Tensor, " 3"]:
    """Where the view matrix takes to 0, in float64 on the CPU.

    -R^T t is that only as far as the rotation, rounded to float32, is orthonormal: 1e6 units away it is wrong by 0.1.

    Raises:
        ValueError: there is no such place, as the matrix is singular.
    """
    exact = camera.viewmat[:3].to("cpu", torch.float64)
    try:
        return torch.linalg.solve(exact[:, :3], -exact[:, 3])
    except torch.linalg.LinAlgError as error:
        raise ValueError(f"the camera's viewmat has no inverse: {exact.tolist()}. Check the camera's pose.") from error


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
    blur: float,
) -> Projected:
    """Project n Gaussians (world units, wxyz) to `camera`; differentiable in means, quats and scales.

    cov = J R M M^T R^T J^T + blur I with M = rotation * scales, R the camera's rotation and J the Jacobian of the
    perspective division at the mean, held within `FOV_MARGIN` of the image (EWA splatting, Zwicker et al. 2001).
    `blur` is a variance, px^2. Rows that are culled get finite values and no gradient. The result has
    the dtype of `means`, except for the conics.
    """
    dtype = means.dtype
    means, quats, scales, viewmat, intrinsics = (
        t.to(means.device, working_dtype(means)) for t in (means, quats, scales, camera.viewmat, camera.K)
    )
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    point = means.unbind(-1)
    x, y, depths = (_dot(rotation[k].unbind(), point) + translation[k] for k in range(3))
    in_front = depths > NEAR_PLANE
    inverse_z = 1 / torch.where(in_front, depths, 1.0)
    u, v = x * inverse_z, y * inverse_z
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    means2d = torch.stack([u * fx + cx, v * fy + cy], dim=-1)
    row_x, row_y = _footprint_rows(
        jacobian_x=_jacobian_row(u, inverse_z, fx, cx, camera.width, rotation[0], rotation[2]),
        jacobian_y=_jacobian_row(v, inverse_z, fy, cy, camera.height, rotation[1], rotation[2]),
        axes=rotation_rows(quats),
        scales=torch.minimum(scales, (STD_MAX / (torch.maximum(fx, fy) * inverse_z))[:, None]).unbind(-1),
    )
    cov_xx = _dot(row_x, row_x) + blur
    cov_xy = _dot(row_x, row_y)
    cov_yy = _dot(row_y, row_y) + blur
    cross = _cross(row_x, row_y)
    det_sharp = _dot(cross, cross)
    det = det_sharp + blur * (cov_xx + cov_yy - blur)
    drawable = in_front & (det > 0)
    inverse_det = 1 / torch.where(drawable, det, 1.0)
    conics = torch.stack([cov_yy, -cov_xy, cov_xx], dim=-1) * inverse_det[:, None]
    radii = _radii(means2d.detach(), cov_xx.detach(), cov_yy.detach(), det.detach(), drawable, camera)
    return Projected(
        means2d=means2d.to(dtype),
        conics=conics,
        depths=depths.to(dtype),
        cov_xx=cov_xx.detach().to(dtype),
        cov_yy=cov_yy.detach().to(dtype),
        compensation=_safe_sqrt(det_sharp * inverse_det).to(dtype),
        radii=radii,
        visible=radii > 0,
    )


def working_dtype(like: Tensor) -> torch.dtype:
    """float64 where the device has it."""
    return torch.float32 if like.device.type == "mps" else torch.float64


def _jacobian_row(
    tangent: Float[Tensor, " n"],
    inverse_z: Float[Tensor, " n"],
    focal: Float[Tensor, ""],
    principal: Float[Tensor, ""],
    size: int,
    axis: Float[Tensor, " 3"],
    forward: Float[Tensor, " 3"],
) -> list[Float[Tensor, " n"]]:
    """One row of J R: the derivative of a pixel coordinate by the world position, px per world unit.

    `tangent` is x/z or y/z; `axis` and `forward` are the camera's rows of R for this coordinate and for z.
    """
    margin = FOV_MARGIN * size / focal
    held = torch.clamp(tangent, min=-principal / focal - margin, max=(size - principal) / focal + margin)
    slope = focal * inverse_z
    return [slope * (axis[k] - held * forward[k]) for k in range(3)]


def _footprint_rows(
    jacobian_x: list[Float[Tensor, " n"]],
    jacobian_y: list[Float[Tensor, " n"]],
    axes: list[list[Float[Tensor, " n"]]],
    scales: tuple[Float[Tensor, " n"], ...],
) -> tuple[list[Float[Tensor, " n"]], list[Float[Tensor, " n"]]]:
    """The rows b0, b1 of J R M, px: the projected covariance is [[b0.b0, b0.b1], [b0.b1, b1.b1]]."""
    row_x, row_y = (
        [(row[0] * axes[0][k] + row[1] * axes[1][k] + row[2] * axes[2][k]) * scales[k] for k in range(3)]
        for row in (jacobian_x, jacobian_y)
    )
    return row_x, row_y


def _dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Float[Tensor, " n"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: list[Float[Tensor, " n"]], b: list[Float[Tensor, " n"]]) -> list[Float[Tensor, " n"]]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _safe_sqrt(x: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """sqrt(x); at 0 (and below the smallest normal number) value and gradient are 0."""
    positive = x > torch.finfo(x.dtype).tiny
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def _radii(
    means2d: Float[Tensor, "n 2"],
    cov_xx: Float[Tensor, " n"],
    cov_yy: Float[Tensor, " n"],
    det: Float[Tensor, " n"],
    drawable: Bool[Tensor, " n"],
    camera: Camera,
) -> Int32[Tensor, " n"]:
    """gsplat's radius, px: ceil(3 sqrt(larger eigenvalue)); 0 where the square around the mean misses the image."""
    half_trace = (cov_xx + cov_yy) / 2
    # the floor of 0.01 is gsplat's; it keeps circles from a root of a negative rounding error
    eigenvalue = half_trace + (half_trace.square() - det).clamp_min(0.01).sqrt()
    radius = torch.ceil(RADIUS_SIGMAS * eigenvalue.sqrt())
    x, y = means2d.unbind(-1)
    inside = (x + radius > 0) & (x - radius < camera.width) & (y + radius > 0) & (y - radius < camera.height)
    return torch.where(drawable & inside, radius, 0.0).clamp_max(2.0**31 - 256).to(torch.int32)
