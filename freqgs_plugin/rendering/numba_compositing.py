"""Compiled front-to-back compositing of tile lists, and its gradient; all level prefixes in one pass.

Every tile keeps one block of scratch per prefix. The first prefix that a Gaussian belongs to computes its alpha; each
block hands alpha on to the next, so one exponential serves them all. Blocks have compile-time strides: that is what
lets LLVM see that reads and writes do not overlap, and vectorise. A finished pixel has its transmittance stored
negative.

Pixels of a tile are ordered by strips of STRIP columns, then rows, so that a small Gaussian touches few of them and any
box of rows in a strip is contiguous.
"""

import numpy as np

from freqgs_plugin.functional.numba_threads import njit, prange
from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from freqgs_plugin.rendering.numba_binning import STRIP, TILE
from freqgs_plugin.rendering.numba_projection import (
    ABS_X,
    ABS_Y,
    HALF_A,
    HALF_C,
    OPACITY,
    STAT_X,
    STAT_Y,
    V_A,
    V_B,
    V_C,
    V_COLUMNS,
    V_OPACITY,
    V_X,
    V_Y,
    B,
    X,
    Y,
)

f4 = np.float32
PIXELS = TILE * TILE
STRIPS = TILE // STRIP
STRIP_PIXELS = TILE * STRIP
_ALPHA_MAX, _ALPHA_MIN, _STOP = f4(ALPHA_MAX), f4(ALPHA_MIN), f4(TRANSMITTANCE_MIN)
_ZERO, _ONE, _HALF, _TWO = f4(0), f4(1), f4(0.5), f4(2)
_CHECK_EVERY = 16
"""Gaussians between two looks at whether a whole tile is finished"""

# exp(-s) on [0, 6] as p(-s / 16)^16; beyond 6 every alpha is under ALPHA_MIN. p: degree-5 fit at Chebyshev points
_REACH = f4(6)
_SIXTEENTH = f4(-1 / 16)
_nodes = -0.1875 + 0.1875 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
_E0, _E1, _E2, _E3, _E4, _E5 = (
    f4(c) for c in np.polynomial.polynomial.polyfit(_nodes, np.exp(_nodes), 5, w=np.exp(-_nodes))
)

# everything but signed zeros, NaN and infinities is exact enough in any order; the inputs are finite by construction
_FAST = {"reassoc", "contract", "nsz", "arcp", "nnan", "ninf"}

# fields of a forward block
PX, PY, ALPHA, LIGHT, F0, F1, F2, DEPTH = range(8)
FORWARD_FIELDS = 8
FORWARD_BLOCK = FORWARD_FIELDS * PIXELS
# fields of a backward block; REST: what later Gaussians and the background still contribute, dotted with the gradient
REST, G0, G1, G2, V_ALPHA, V_STAT = range(4, 10)
BACKWARD_FIELDS = 10
BACKWARD_BLOCK = BACKWARD_FIELDS * PIXELS


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _falloff(s):
    x = min(s, _REACH) * _SIXTEENTH
    p = _E0 + x * (_E1 + x * (_E2 + x * (_E3 + x * (_E4 + x * _E5))))
    p = p * p
    p = p * p
    p = p * p
    return p * p


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _alpha(block, i, gx, gy, ha, b, hc, opacity):
    dx, dy = block[i + PX * PIXELS] - gx, block[i + PY * PIXELS] - gy
    alpha = min(opacity * _falloff(ha * dx * dx + hc * dy * dy + b * dx * dy), _ALPHA_MAX)
    return alpha if alpha >= _ALPHA_MIN else _ZERO


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _blend(block, i, alpha, c0, c1, c2):
    """Take one Gaussian's share of pixel i's light; returns the share."""
    light = block[i + LIGHT * PIXELS]
    weight = alpha * max(light, _ZERO)
    left = light - weight
    going = left > _STOP
    weight = weight if going else _ZERO
    block[i + LIGHT * PIXELS] = left if going else -abs(light)
    block[i + F0 * PIXELS] += weight * c0
    block[i + F1 * PIXELS] += weight * c1
    block[i + F2 * PIXELS] += weight * c2
    return weight


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _forward_only(block, n, gx, gy, ha, b, hc, opacity, c0, c1, c2):
    for i in range(n):
        _blend(block, i, _alpha(block, i, gx, gy, ha, b, hc, opacity), c0, c1, c2)


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _forward_only_with_depth(block, n, gx, gy, ha, b, hc, opacity, c0, c1, c2, z):
    for i in range(n):
        weight = _blend(block, i, _alpha(block, i, gx, gy, ha, b, hc, opacity), c0, c1, c2)
        block[i + DEPTH * PIXELS] += weight * z


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _forward_first(block, n, gx, gy, ha, b, hc, opacity, c0, c1, c2):
    for i in range(n):
        alpha = _alpha(block, i, gx, gy, ha, b, hc, opacity)
        block[i + FORWARD_BLOCK + ALPHA * PIXELS] = alpha
        _blend(block, i, alpha, c0, c1, c2)


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _forward_next(block, n, c0, c1, c2):
    for i in range(n):
        alpha = block[i + ALPHA * PIXELS]
        block[i + FORWARD_BLOCK + ALPHA * PIXELS] = alpha
        _blend(block, i, alpha, c0, c1, c2)


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _brightest(light):
    brightest = _ZERO
    for i in range(PIXELS):
        brightest = max(brightest, light[i])
    return brightest


@njit(error_model="numpy", inline="always")
def _pixel(strip, row, column):
    return strip * STRIP_PIXELS + row * STRIP + column


@njit(error_model="numpy", inline="always")
def _start_block(block, tx, ty, width, height):
    """Pixel centres relative to the tile; light 1 inside the image and 'finished' outside of it."""
    for strip in range(STRIPS):
        for row in range(TILE):
            for column in range(STRIP):
                p = _pixel(strip, row, column)
                x, y = strip * STRIP + column, row
                block[p + PX * PIXELS] = f4(x) + _HALF
                block[p + PY * PIXELS] = f4(y) + _HALF
                inside = tx * TILE + x < width and ty * TILE + y < height
                block[p + LIGHT * PIXELS] = _ONE if inside else -_ONE


@njit(error_model="numpy", inline="always")
def _all_finished(scratch, prefixes, stride):
    for k in range(prefixes):
        if _brightest(scratch[k * stride + LIGHT * PIXELS :]) > _ZERO:
            return False
    return True


@njit(parallel=True, fastmath=_FAST, error_model="numpy", cache=True)
def composite(
    offsets, ids, boxes, splats, depths, level, prefixes, features, with_depth, width, height, image, light, depth
):
    """Fill `image` [prefixes, h, w, 3], `light` (final transmittance) [prefixes, h, w] and, if asked, `depth` [h, w].

    `level` [n] in 1..prefixes; with one prefix and all levels 1 this is plain compositing. Depth needs one prefix.
    """
    tiles_x = (width + TILE - 1) // TILE
    for t in prange(offsets.shape[0] - 1):
        ty = t // tiles_x
        tx = t - ty * tiles_x
        scratch = np.zeros((prefixes + 1) * FORWARD_BLOCK, np.float32)
        for k in range(prefixes):
            _start_block(scratch[k * FORWARD_BLOCK :], tx, ty, width, height)
        since_check = 0
        for entry in range(offsets[t], offsets[t + 1]):
            i, box = ids[entry], np.int64(boxes[entry])
            gx, gy = splats[i, X] - f4(tx * TILE), splats[i, Y] - f4(ty * TILE)
            ha, b, hc, opacity = splats[i, HALF_A], splats[i, B], splats[i, HALF_C], splats[i, OPACITY]
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            row, n = box & 15, ((box >> 4 & 15) - (box & 15) + 1) * STRIP
            for strip in range(box >> 8 & 15, (box >> 12) + 1):
                at = _pixel(strip, row, 0)
                if prefixes == 1:
                    if with_depth:
                        _forward_only_with_depth(scratch[at:], n, gx, gy, ha, b, hc, opacity, c0, c1, c2, depths[i])
                    else:
                        _forward_only(scratch[at:], n, gx, gy, ha, b, hc, opacity, c0, c1, c2)
                else:
                    k = level[i] - 1
                    _forward_first(scratch[k * FORWARD_BLOCK + at :], n, gx, gy, ha, b, hc, opacity, c0, c1, c2)
                    for later in range(k + 1, prefixes):
                        _forward_next(scratch[later * FORWARD_BLOCK + at :], n, c0, c1, c2)
            since_check += 1
            if since_check == _CHECK_EVERY:
                since_check = 0
                if _all_finished(scratch, prefixes, FORWARD_BLOCK):
                    break
        for k in range(prefixes):
            block = scratch[k * FORWARD_BLOCK :]
            for row in range(min(TILE, height - ty * TILE)):
                for x in range(min(TILE, width - tx * TILE)):
                    p = _pixel(x // STRIP, row, x % STRIP)
                    y, c = ty * TILE + row, tx * TILE + x
                    image[k, y, c, 0] = block[p + F0 * PIXELS]
                    image[k, y, c, 1] = block[p + F1 * PIXELS]
                    image[k, y, c, 2] = block[p + F2 * PIXELS]
                    light[k, y, c] = abs(block[p + LIGHT * PIXELS])
                    if with_depth:
                        depth[y, c] = block[p + DEPTH * PIXELS]


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _unblend(block, i, alpha, c0, c1, c2):
    """Repeat `_blend` at pixel i; returns weight, the gradient's feature components, and dL/dalpha."""
    light = block[i + LIGHT * PIXELS]
    weight = alpha * max(light, _ZERO)
    left = light - weight
    going = left > _STOP
    weight = weight if going else _ZERO
    block[i + LIGHT * PIXELS] = left if going else -abs(light)
    g0, g1, g2 = block[i + G0 * PIXELS], block[i + G1 * PIXELS], block[i + G2 * PIXELS]
    q = c0 * g0 + c1 * g1 + c2 * g2
    rest = block[i + REST * PIXELS] - weight * q
    block[i + REST * PIXELS] = rest
    v_alpha = light * q - rest / (_ONE - alpha)
    return weight, g0, g1, g2, v_alpha if going else _ZERO


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _backward_only(block, n, gx, gy, ha, b, hc, opacity, c0, c1, c2):
    s0 = s1 = s2 = s = sx = sy = sxx = sxy = syy = ax = ay = _ZERO
    a2, c2c = _TWO * ha, _TWO * hc
    for i in range(n):
        alpha = _alpha(block, i, gx, gy, ha, b, hc, opacity)
        weight, g0, g1, g2, v = _unblend(block, i, alpha, c0, c1, c2)
        s0 += weight * g0
        s1 += weight * g1
        s2 += weight * g2
        dx, dy = block[i + PX * PIXELS] - gx, block[i + PY * PIXELS] - gy
        v = alpha * v if alpha < _ALPHA_MAX else _ZERO
        s += v
        vx, vy = v * dx, v * dy
        sx += vx
        sy += vy
        sxx += vx * dx
        sxy += vx * dy
        syy += vy * dy
        ax += abs(a2 * vx + b * vy)
        ay += abs(b * vx + c2c * vy)
    return s0, s1, s2, s, sx, sy, sxx, sxy, syy, ax, ay


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _backward_first(block, n, gx, gy, ha, b, hc, opacity, c0, c1, c2, stat):
    s0 = s1 = s2 = _ZERO
    for i in range(n):
        alpha = _alpha(block, i, gx, gy, ha, b, hc, opacity)
        block[i + BACKWARD_BLOCK + ALPHA * PIXELS] = alpha
        weight, g0, g1, g2, v = _unblend(block, i, alpha, c0, c1, c2)
        block[i + BACKWARD_BLOCK + V_ALPHA * PIXELS] = v
        block[i + BACKWARD_BLOCK + V_STAT * PIXELS] = stat * v
        s0 += weight * g0
        s1 += weight * g1
        s2 += weight * g2
    return s0, s1, s2


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _backward_next(block, n, c0, c1, c2, stat):
    s0 = s1 = s2 = _ZERO
    for i in range(n):
        alpha = block[i + ALPHA * PIXELS]
        block[i + BACKWARD_BLOCK + ALPHA * PIXELS] = alpha
        weight, g0, g1, g2, v = _unblend(block, i, alpha, c0, c1, c2)
        block[i + BACKWARD_BLOCK + V_ALPHA * PIXELS] = block[i + V_ALPHA * PIXELS] + v
        block[i + BACKWARD_BLOCK + V_STAT * PIXELS] = block[i + V_STAT * PIXELS] + stat * v
        s0 += weight * g0
        s1 += weight * g1
        s2 += weight * g2
    return s0, s1, s2


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _moments(block, n, gx, gy, ha, b, hc):
    """Sums over pixels of alpha dL/dalpha times 1, d, d d^T; times d also for the statistic's part, and absolutes."""
    s = sx = sy = sxx = sxy = syy = tx = ty = ax = ay = _ZERO
    a2, c2 = _TWO * ha, _TWO * hc
    for i in range(n):
        dx, dy = block[i + PX * PIXELS] - gx, block[i + PY * PIXELS] - gy
        alpha = block[i + ALPHA * PIXELS]
        alpha = alpha if alpha < _ALPHA_MAX else _ZERO
        v, u = alpha * block[i + V_ALPHA * PIXELS], alpha * block[i + V_STAT * PIXELS]
        s += v
        vx, vy = v * dx, v * dy
        sx += vx
        sy += vy
        sxx += vx * dx
        sxy += vx * dy
        syy += vy * dy
        ux, uy = u * dx, u * dy
        tx += ux
        ty += uy
        ax += abs(a2 * ux + b * uy)
        ay += abs(b * ux + c2 * uy)
    return s, sx, sy, sxx, sxy, syy, tx, ty, ax, ay


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _add_moments(out, opacity, a, b, c, s, sx, sy, sxx, sxy, syy, tx, ty, ax, ay):
    out[V_OPACITY] += s / opacity
    out[V_X] += a * sx + b * sy
    out[V_Y] += b * sx + c * sy
    out[V_A] -= _HALF * sxx
    out[V_B] -= sxy
    out[V_C] -= _HALF * syy
    out[STAT_X] += a * tx + b * ty
    out[STAT_Y] += b * tx + c * ty
    out[ABS_X] += ax
    out[ABS_Y] += ay


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _start_gradient(block, tx, ty, width, height, image, light, v_image, v_light):
    _start_block(block, tx, ty, width, height)
    for row in range(min(TILE, height - ty * TILE)):
        for x in range(min(TILE, width - tx * TILE)):
            p = _pixel(x // STRIP, row, x % STRIP)
            y, c = ty * TILE + row, tx * TILE + x
            g0, g1, g2 = v_image[y, c, 0], v_image[y, c, 1], v_image[y, c, 2]
            block[p + G0 * PIXELS], block[p + G1 * PIXELS], block[p + G2 * PIXELS] = g0, g1, g2
            done = g0 * image[y, c, 0] + g1 * image[y, c, 1] + g2 * image[y, c, 2]
            block[p + REST * PIXELS] = done + light[y, c] * v_light[y, c]


@njit(parallel=True, fastmath=_FAST, error_model="numpy", cache=True)
def composite_backward(
    offsets, ids, boxes, slots, splats, level, prefixes, own, features, width, height,
    image, light, v_image, v_light, partial,
):  # fmt: skip
    """Write each entry's gradient to its slot of `partial` [entries, V_COLUMNS]: no two threads share a slot.

    `own`: the statistic columns hold the gradient of the prefix that equals the Gaussian's level, else of the last one.
    """
    tiles_x = (width + TILE - 1) // TILE
    for t in prange(offsets.shape[0] - 1):
        ty = t // tiles_x
        tx = t - ty * tiles_x
        scratch = np.zeros((prefixes + 1) * BACKWARD_BLOCK, np.float32)
        for k in range(prefixes):
            block = scratch[k * BACKWARD_BLOCK :]
            _start_gradient(block, tx, ty, width, height, image[k], light[k], v_image[k], v_light[k])
        _start_block(scratch[prefixes * BACKWARD_BLOCK :], tx, ty, width, height)
        since_check = 0
        finished = False
        for entry in range(offsets[t], offsets[t + 1]):
            out = partial[slots[entry]]
            for column in range(V_COLUMNS):
                out[column] = _ZERO
            if finished:
                continue
            i, box = ids[entry], np.int64(boxes[entry])
            gx, gy = splats[i, X] - f4(tx * TILE), splats[i, Y] - f4(ty * TILE)
            ha, b, hc, opacity = splats[i, HALF_A], splats[i, B], splats[i, HALF_C], splats[i, OPACITY]
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            row, n = box & 15, ((box >> 4 & 15) - (box & 15) + 1) * STRIP
            for strip in range(box >> 8 & 15, (box >> 12) + 1):
                at = _pixel(strip, row, 0)
                if prefixes == 1:
                    s0, s1, s2, s, sx, sy, sxx, sxy, syy, ax, ay = _backward_only(
                        scratch[at:], n, gx, gy, ha, b, hc, opacity, c0, c1, c2
                    )
                    ux, uy = sx, sy
                else:
                    k = level[i] - 1
                    stat = _ONE if own or k == prefixes - 1 else _ZERO
                    s0, s1, s2 = _backward_first(
                        scratch[k * BACKWARD_BLOCK + at :], n, gx, gy, ha, b, hc, opacity, c0, c1, c2, stat
                    )
                    for later in range(k + 1, prefixes):
                        stat = _ONE if not own and later == prefixes - 1 else _ZERO
                        r0, r1, r2 = _backward_next(scratch[later * BACKWARD_BLOCK + at :], n, c0, c1, c2, stat)
                        s0 += r0
                        s1 += r1
                        s2 += r2
                    s, sx, sy, sxx, sxy, syy, ux, uy, ax, ay = _moments(
                        scratch[prefixes * BACKWARD_BLOCK + at :], n, gx, gy, ha, b, hc
                    )
                out[0] += s0
                out[1] += s1
                out[2] += s2
                _add_moments(out, opacity, _TWO * ha, b, _TWO * hc, s, sx, sy, sxx, sxy, syy, ux, uy, ax, ay)
            since_check += 1
            if since_check == _CHECK_EVERY:
                since_check = 0
                finished = _all_finished(scratch, prefixes, BACKWARD_BLOCK)
