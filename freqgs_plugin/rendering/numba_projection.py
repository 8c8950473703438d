"""Compiled projection of 3D Gaussians to the image, and its gradient.

The same equations as `functional.projection`, which is the reference: EWA splatting with the determinant as
|b0 x b1|^2 plus blur terms, where b0 and b1 are the rows of J R M (M: rotation times scales). Parameters are float32;
each Gaussian is projected in float64 because that costs little here and covariances cancel badly in float32.
"""

import math

import numpy as np

from freqgs_plugin.functional.numba_lanes import TOTALS, add_row
from freqgs_plugin.functional.numba_threads import njit, prange
from freqgs_plugin.functional.projection import QUATERNION_MIN, STD_MAX
from freqgs_plugin.rendering.base import ALPHA_MIN, FOV_MARGIN, NEAR_PLANE, RADIUS_SIGMAS

# columns of a projected Gaussian: centre (px), its falloff exp(-(U dx + S dy)^2 - V dy^2), opacity after compensation,
# and the half-width and half-height (px) of the ellipse on which alpha >= ALPHA_MIN
X, Y, U, S, V, OPACITY, REACH_X, REACH_Y = range(8)
COLUMNS = 8
_CHUNK = 256
"""Gaussians that one thread takes at a time"""

# what a Gaussian's gradient is made of, as sums over pixels (of one tile): three columns for its features, then moments
# of g = alpha dL/dalpha in u = U dx + S dy and dy, first moments of the judged part of g, and of its absolutes
MASS, M_U, M_Y, M_UU, M_UY, M_YY, STAT_U, STAT_Y, ABS_X, ABS_Y = range(3, 13)
V_COLUMNS = TOTALS


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _rotation(w, x, y, z):
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _unit(quats, i):
    """Normalised quaternion and 1/norm; the identity, with 0 for 1/norm, where no component is above the minimum."""
    w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    if not max(max(abs(w), abs(x)), max(abs(y), abs(z))) > QUATERNION_MIN:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _sizes(scales, i, fx, fy, iz):
    """Scales, limited to about `STD_MAX` pixels, and 1 for each that is not limited, else 0."""
    limit = STD_MAX / (max(fx, fy) * iz)
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    free = (1.0 if s0 <= limit else 0.0, 1.0 if s1 <= limit else 0.0, 1.0 if s2 <= limit else 0.0)
    return (min(s0, limit), min(s1, limit), min(s2, limit)), free


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _jacobian(R, fx, fy, iz, tu, tv):
    """Rows of J R: gradients of the image position with respect to the world position."""
    j0 = (fx * iz * (R[0, 0] - tu * R[2, 0]), fx * iz * (R[0, 1] - tu * R[2, 1]), fx * iz * (R[0, 2] - tu * R[2, 2]))
    j1 = (fy * iz * (R[1, 0] - tv * R[2, 0]), fy * iz * (R[1, 1] - tv * R[2, 1]), fy * iz * (R[1, 2] - tv * R[2, 2]))
    return j0, j1


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _row(j, M, c):
    return j[0] * M[0][c] + j[1] * M[1][c] + j[2] * M[2][c]


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _limits(fx, fy, cx, cy, width, height):
    """Range of x/z and y/z on which the Jacobian is taken: the image and a margin."""
    margin_x, margin_y = FOV_MARGIN * width / fx, FOV_MARGIN * height / fy
    return -cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y


@njit(error_model="numpy", fastmath={"contract"}, inline="always")
def _project_one(
    i, means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased, out, conics, depths, radii
):  # fmt: skip
    fx, fy, cx, cy = intrinsics
    low_u, high_u, low_v, high_v = _limits(fx, fy, cx, cy, width, height)
    R = view[:3, :3]
    m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    z = R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2 + view[2, 3]
    depths[i] = z
    radii[i] = 0
    for column in range(COLUMNS):
        out[i, column] = 0.0
    conics[i, 0] = conics[i, 1] = conics[i, 2] = 0.0
    if not (z > NEAR_PLANE):
        return
    iz = 1.0 / z
    u = (R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2 + view[0, 3]) * iz
    v = (R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2 + view[1, 3]) * iz
    j0, j1 = _jacobian(R, fx, fy, iz, min(max(u, low_u), high_u), min(max(v, low_v), high_v))
    qw, qx, qy, qz, _ = _unit(quats, i)
    M = _rotation(qw, qx, qy, qz)
    (s0, s1, s2), _ = _sizes(scales, i, fx, fy, iz)
    b00, b01, b02 = _row(j0, M, 0) * s0, _row(j0, M, 1) * s1, _row(j0, M, 2) * s2
    b10, b11, b12 = _row(j1, M, 0) * s0, _row(j1, M, 1) * s1, _row(j1, M, 2) * s2
    a = b00 * b00 + b01 * b01 + b02 * b02
    b = b00 * b10 + b01 * b11 + b02 * b12
    c = b10 * b10 + b11 * b11 + b12 * b12
    k0, k1, k2 = b01 * b12 - b02 * b11, b02 * b10 - b00 * b12, b00 * b11 - b01 * b10
    det_sharp = k0 * k0 + k1 * k1 + k2 * k2
    det = det_sharp + blur * (a + c) + blur * blur
    if not (det > 0.0 and det < np.inf):
        return
    a += blur
    c += blur
    x, y = u * fx + cx, v * fy + cy
    out[i, X], out[i, Y] = x, y
    conics[i, 0], conics[i, 1], conics[i, 2] = c / det, -b / det, a / det
    slope = math.sqrt(0.5 * c / det)
    out[i, U], out[i, S], out[i, V] = slope, -slope * b / c, 0.5 / c
    middle = 0.5 * (a + c)
    radius = math.ceil(RADIUS_SIGMAS * math.sqrt(middle + math.sqrt(max(0.01, middle * middle - det))))
    if not (x + radius > 0 and x - radius < width and y + radius > 0 and y - radius < height):
        return
    radii[i] = int(min(radius, 2147483000.0))
    opacity = np.float64(opacities[i])
    if antialiased:
        opacity *= math.sqrt(det_sharp / det)
    if not (opacity >= ALPHA_MIN):
        return
    out[i, OPACITY] = opacity
    reach = 2.0 * math.log(opacity / ALPHA_MIN)
    out[i, REACH_X], out[i, REACH_Y] = math.sqrt(reach * a), math.sqrt(reach * c)


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def project(
    means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased, out, conics, depths, radii
):
    """Fill `out` [n, COLUMNS], `conics` [n, 3], `depths` [n] and `radii` [n] (px, 0 where culled)."""
    for i in prange(means.shape[0]):
        _project_one(
            i, means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased,
            out, conics, depths, radii,
        )  # fmt: skip


@njit(error_model="numpy", fastmath={"contract"}, inline="always")
def _carry_back_one(
    i, means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased, moves,
    splats, sums, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_abs, v_view,
):  # fmt: skip
    fx, fy, cx, cy = intrinsics
    low_u, high_u, low_v, high_v = _limits(fx, fy, cx, cy, width, height)
    R = view[:3, :3]
    want_view = v_view.shape[0] > 0
    su, ss, sv = np.float64(splats[i, U]), np.float64(splats[i, S]), np.float64(splats[i, V])
    v_features[i, 0], v_features[i, 1], v_features[i, 2] = sums[0], sums[1], sums[2]
    v_means2d[i, 0] = 2.0 * su * sums[STAT_U]
    v_means2d[i, 1] = 2.0 * (ss * sums[STAT_U] + sv * sums[STAT_Y])
    v_abs[i, 0], v_abs[i, 1] = su * sums[ABS_X], sums[ABS_Y]
    if not moves:
        return
    v_alpha = sums[MASS] / splats[i, OPACITY]
    v_x, v_y = 2.0 * su * sums[M_U], 2.0 * (ss * sums[M_U] + sv * sums[M_Y])
    # of the conic in exp(-(A dx^2 + 2 B dx dy + C dy^2) / 2), with dx = (u - S dy) / U
    m_xy = (sums[M_UY] - ss * sums[M_YY]) / su
    m_xx = (sums[M_UU] - 2.0 * ss * sums[M_UY] + ss * ss * sums[M_YY]) / (su * su)
    v_a, v_b, v_c = -0.5 * m_xx, -m_xy, -0.5 * sums[M_YY]

    m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    z = R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2 + view[2, 3]
    px = R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2 + view[0, 3]
    py = R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2 + view[1, 3]
    iz = 1.0 / z
    u, v = px * iz, py * iz
    tu, tv = min(max(u, low_u), high_u), min(max(v, low_v), high_v)
    j0, j1 = _jacobian(R, fx, fy, iz, tu, tv)
    qw, qx, qy, qz, inverse_norm = _unit(quats, i)
    M = _rotation(qw, qx, qy, qz)
    s, free = _sizes(scales, i, fx, fy, iz)
    h0 = (_row(j0, M, 0), _row(j0, M, 1), _row(j0, M, 2))
    h1 = (_row(j1, M, 0), _row(j1, M, 1), _row(j1, M, 2))
    b0 = (h0[0] * s[0], h0[1] * s[1], h0[2] * s[2])
    b1 = (h1[0] * s[0], h1[1] * s[1], h1[2] * s[2])
    a = b0[0] * b0[0] + b0[1] * b0[1] + b0[2] * b0[2]
    b = b0[0] * b1[0] + b0[1] * b1[1] + b0[2] * b1[2]
    c = b1[0] * b1[0] + b1[1] * b1[1] + b1[2] * b1[2]
    k = (b0[1] * b1[2] - b0[2] * b1[1], b0[2] * b1[0] - b0[0] * b1[2], b0[0] * b1[1] - b0[1] * b1[0])
    det_sharp = k[0] * k[0] + k[1] * k[1] + k[2] * k[2]
    inverse_det = 1.0 / (det_sharp + blur * (a + c) + blur * blur)
    a += blur
    c += blur

    # conic = (c, -b, a) / det; opacity = o sqrt(det_sharp / det)
    g_det = -inverse_det * inverse_det * (c * v_a - b * v_b + a * v_c)
    g_sharp = 0.0
    if antialiased:
        ratio = det_sharp * inverse_det
        compensation = math.sqrt(ratio)
        v_opacities[i] = v_alpha * compensation
        g_ratio = v_alpha * opacities[i] * 0.5 / compensation
        g_sharp = g_ratio * inverse_det
        g_det -= g_ratio * ratio * inverse_det
    else:
        v_opacities[i] = v_alpha
    g_sharp += g_det
    g_a = v_c * inverse_det + g_det * blur
    g_b = -v_b * inverse_det
    g_c = v_a * inverse_det + g_det * blur
    gk = (2.0 * k[0] * g_sharp, 2.0 * k[1] * g_sharp, 2.0 * k[2] * g_sharp)
    gb0 = (
        2.0 * g_a * b0[0] + g_b * b1[0] + b1[1] * gk[2] - b1[2] * gk[1],
        2.0 * g_a * b0[1] + g_b * b1[1] + b1[2] * gk[0] - b1[0] * gk[2],
        2.0 * g_a * b0[2] + g_b * b1[2] + b1[0] * gk[1] - b1[1] * gk[0],
    )
    gb1 = (
        2.0 * g_c * b1[0] + g_b * b0[0] + gk[1] * b0[2] - gk[2] * b0[1],
        2.0 * g_c * b1[1] + g_b * b0[1] + gk[2] * b0[0] - gk[0] * b0[2],
        2.0 * g_c * b1[2] + g_b * b0[2] + gk[0] * b0[1] - gk[1] * b0[0],
    )
    v_scales[i, 0] = free[0] * (gb0[0] * h0[0] + gb1[0] * h1[0])
    v_scales[i, 1] = free[1] * (gb0[1] * h0[1] + gb1[1] * h1[1])
    v_scales[i, 2] = free[2] * (gb0[2] * h0[2] + gb1[2] * h1[2])
    gh0 = (gb0[0] * s[0], gb0[1] * s[1], gb0[2] * s[2])
    gh1 = (gb1[0] * s[0], gb1[1] * s[1], gb1[2] * s[2])

    # rotation: dL/dM[r][c] = j0[r] gh0[c] + j1[r] gh1[c]
    n00, n01, n02 = j0[0] * gh0[0] + j1[0] * gh1[0], j0[0] * gh0[1] + j1[0] * gh1[1], j0[0] * gh0[2] + j1[0] * gh1[2]
    n10, n11, n12 = j0[1] * gh0[0] + j1[1] * gh1[0], j0[1] * gh0[1] + j1[1] * gh1[1], j0[1] * gh0[2] + j1[1] * gh1[2]
    n20, n21, n22 = j0[2] * gh0[0] + j1[2] * gh1[0], j0[2] * gh0[1] + j1[2] * gh1[1], j0[2] * gh0[2] + j1[2] * gh1[2]
    gw = 2.0 * (qx * (n21 - n12) + qy * (n02 - n20) + qz * (n10 - n01))
    gx = 2.0 * (-2.0 * qx * (n11 + n22) + qy * (n01 + n10) + qz * (n02 + n20) + qw * (n21 - n12))
    gy = 2.0 * (qx * (n01 + n10) - 2.0 * qy * (n00 + n22) + qz * (n12 + n21) + qw * (n02 - n20))
    gz = 2.0 * (qx * (n02 + n20) + qy * (n12 + n21) - 2.0 * qz * (n00 + n11) + qw * (n10 - n01))
    along = gw * qw + gx * qx + gy * qy + gz * qz
    v_quats[i, 0] = (gw - along * qw) * inverse_norm
    v_quats[i, 1] = (gx - along * qx) * inverse_norm
    v_quats[i, 2] = (gy - along * qy) * inverse_norm
    v_quats[i, 3] = (gz - along * qz) * inverse_norm

    # position: through the image centre and through the Jacobian
    gj0 = (
        gh0[0] * M[0][0] + gh0[1] * M[0][1] + gh0[2] * M[0][2],
        gh0[0] * M[1][0] + gh0[1] * M[1][1] + gh0[2] * M[1][2],
        gh0[0] * M[2][0] + gh0[1] * M[2][1] + gh0[2] * M[2][2],
    )
    gj1 = (
        gh1[0] * M[0][0] + gh1[1] * M[0][1] + gh1[2] * M[0][2],
        gh1[0] * M[1][0] + gh1[1] * M[1][1] + gh1[2] * M[1][2],
        gh1[0] * M[2][0] + gh1[1] * M[2][1] + gh1[2] * M[2][2],
    )
    g_u, g_v = v_x * fx, v_y * fy
    if tu == u:
        g_u -= fx * iz * (gj0[0] * R[2, 0] + gj0[1] * R[2, 1] + gj0[2] * R[2, 2])
    if tv == v:
        g_v -= fy * iz * (gj1[0] * R[2, 0] + gj1[1] * R[2, 1] + gj1[2] * R[2, 2])
    g_iz = z * (gj0[0] * j0[0] + gj0[1] * j0[1] + gj0[2] * j0[2] + gj1[0] * j1[0] + gj1[1] * j1[1] + gj1[2] * j1[2])
    p0, p1 = g_u * iz, g_v * iz
    p2 = -iz * iz * (g_iz + g_u * px + g_v * py)
    for c3 in range(3):
        v_means[i, c3] = R[0, c3] * p0 + R[1, c3] * p1 + R[2, c3] * p2
    if want_view:
        m = (m0, m1, m2)
        for c3 in range(3):
            v_view[i, c3] = p0 * m[c3] + fx * iz * gj0[c3]
            v_view[i, 3 + c3] = p1 * m[c3] + fy * iz * gj1[c3]
            v_view[i, 6 + c3] = p2 * m[c3] - fx * iz * tu * gj0[c3] - fy * iz * tv * gj1[c3]
        v_view[i, 9], v_view[i, 10], v_view[i, 11] = p0, p1, p2


@njit(error_model="numpy", inline="always")
def _clear_one(i, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_abs):
    for column in range(3):
        v_means[i, column] = v_scales[i, column] = v_features[i, column] = 0.0
    for column in range(4):
        v_quats[i, column] = 0.0
    for column in range(2):
        v_means2d[i, column] = v_abs[i, column] = 0.0
    v_opacities[i] = 0.0


@njit(parallel=True, error_model="numpy", fastmath={"contract"}, cache=True)
def project_backward(
    means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased, moves, splats,
    first, count, partial, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_abs, v_view,
):  # fmt: skip
    """Sum each Gaussian's rows of `partial` [slots * V_COLUMNS] and carry them back to its parameters.

    `first` and `count` [n] name a Gaussian's rows, `splats` [n, COLUMNS] is what `project` made of it. `v_view` [n, 12]
    receives each Gaussian's share of the gradient of the world-to-camera matrix (rows of R, then t) unless it has no
    rows. Unless `moves`, only features and statistics are wanted.
    """
    n = means.shape[0]
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        sums = np.empty(V_COLUMNS)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            _clear_one(i, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_abs)
            if count[i] > 0:
                sums[:] = 0.0
                for row in range(first[i], first[i] + count[i]):
                    add_row(sums, partial, row * V_COLUMNS)
                _carry_back_one(
                    i, means, quats, scales, opacities, view, intrinsics, width, height, blur, antialiased, moves,
                    splats, sums, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_abs, v_view,
                )  # fmt: skip
