"""Compiled front-to-back compositing of tile lists, and its gradient; all level prefixes in one pass.

Every tile keeps one block of scratch per prefix, and walks its Gaussians from front to back, each over the rows and
8-pixel strips that its ellipse meets, eight pixels at a time. Alpha is computed once and blended into the blocks of all
prefixes that the Gaussian belongs to. A finished pixel has its transmittance stored negative.

Pixels of a tile are ordered by strips of STRIP columns, then rows. Within a strip dx is the same in every row, so a row
costs one multiply-add for u in alpha = opacity exp(-(u^2 + v^2)), u = U dx + S dy, v^2 = V dy^2. Gradients are summed
as moments of u and dy: along a thin Gaussian u stays small, where dx^2 would drown what is across it.
"""

import numpy as np

from freqgs_plugin.functional.numba_lanes import (
    LANES,
    any_set,
    lanes,
    load,
    magnitude,
    maximum,
    minimum,
    prefetch_to_write,
    select,
    store,
    store_totals,
)
from freqgs_plugin.functional.numba_threads import njit, prange
from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from freqgs_plugin.rendering.numba_binning import BOX, ID, SLOT, STRIP, TILE
from freqgs_plugin.rendering.numba_projection import OPACITY, V_COLUMNS, S, U, V, X, Y

ROWS = LANES // STRIP
"""rows of a strip that are computed at once"""
f4 = np.float32
PIXELS = TILE * TILE
STRIP_PIXELS = TILE * STRIP
_ALPHA_MAX, _ALPHA_MIN, _STOP = f4(ALPHA_MAX), f4(ALPHA_MIN), f4(TRANSMITTANCE_MIN)
_ZERO, _ONE, _HALF, _FOUR, _EIGHT = f4(0), f4(1), f4(0.5), f4(4), f4(8)
_CHECK_EVERY = 16
"""Gaussians between two looks at which rows of a tile are unfinished"""

_LINE = 16
"""numbers of a cache line"""

# exp(-s) on [0, 6] as p(-s / 16)^16; beyond 6 every alpha is under ALPHA_MIN. p: degree-5 fit at Chebyshev points
_LEAST = f4(-6 / 16)
_QUARTER, _SIXTEENTH = f4(1 / 4), f4(1 / 16)
_nodes = -0.1875 + 0.1875 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
_E0, _E1, _E2, _E3, _E4, _E5 = (
    f4(c) for c in np.polynomial.polynomial.polyfit(_nodes, np.exp(_nodes), 5, w=np.exp(-_nodes))
)

_FAST = {"reassoc", "contract", "nsz", "arcp", "nnan", "ninf"}

# fields of a forward block; each is one number per pixel
LIGHT, F0, F1, F2, DEPTH = range(5)
FORWARD_BLOCK = 5 * PIXELS
# fields of a backward block; REST: what later Gaussians and the background still contribute, dotted with the gradient
REST, G0, G1, G2 = range(1, 5)
BACKWARD_BLOCK = 5 * PIXELS


@njit(error_model="numpy", fastmath=_FAST, inline="always")
def _alpha(u, v2, opacity):
    """opacity exp(-(u^2 + v2)), capped, and 0 where it is under ALPHA_MIN; u and v2 are scaled by 1/4 and 1/16."""
    x = maximum(lanes(_ZERO) - u * u - v2, lanes(_LEAST))
    p = _E0 + x * (_E1 + x * (_E2 + x * (_E3 + x * (_E4 + x * _E5))))
    p = p * p
    p = p * p
    p = p * p
    alpha = minimum(p * p * opacity, lanes(_ALPHA_MAX))
    return select(alpha >= _ALPHA_MIN, alpha, lanes(_ZERO))


@njit(error_model="numpy", inline="always")
def _first_prefix(level, i):
    """Where Gaussian i joins; without levels a constant, which removes the loop over prefixes."""
    if level is None:
        return 0
    return level[i] - 1


@njit(error_model="numpy", inline="always")
def _last_prefix(level, prefixes):
    if level is None:
        return 0
    return prefixes - 1


@njit(error_model="numpy", cache=True)
def _lane_centres():
    """Pixel centres of each lane: column in the strip, and row."""
    lane = np.arange(LANES)
    return (lane % STRIP).astype(np.float32) + _HALF, (lane // STRIP).astype(np.float32) + _HALF


@njit(error_model="numpy", cache=True)
def _scratch(size):
    """`size` zeros that begin on a cache line: a vector of 64 bytes elsewhere takes two."""
    raw = np.zeros(size + _LINE, np.float32)
    first = (64 - raw.ctypes.data % 64) % 64 // 4
    return raw[first : first + size]


@njit(error_model="numpy", inline="always")
def _start_light(scratch, at, tx, ty, width, height):
    """Light 1 inside the image, 'finished' outside of it."""
    across, down = width - tx * TILE, height - ty * TILE
    if across >= TILE and down >= TILE:
        for p in range(0, PIXELS, LANES):
            store(scratch, at + p, lanes(_ONE))
        return
    for start in range(0, TILE, STRIP):
        for row in range(TILE):
            p = at + _pixel(start, row)
            for x in range(STRIP):
                scratch[p + x] = _ONE if start + x < across and row < down else -_ONE


@njit(error_model="numpy", inline="always")
def _pixel(x, row):
    return x // STRIP * STRIP_PIXELS + row * STRIP + x % STRIP


@njit(error_model="numpy", fastmath=_FAST, cache=True)
def _unfinished_rows(scratch, prefixes, block):
    """First and last row with an unfinished pixel in any prefix; TILE and -1 if there is none."""
    first, last = TILE, -1
    for row in range(0, TILE, ROWS):
        # the first prefix, of the fewest Gaussians, is nearly always the last to finish
        for k in range(prefixes):
            brightest = lanes(-_ONE)
            for x in range(0, TILE, STRIP):
                brightest = maximum(brightest, load(scratch, k * block + LIGHT * PIXELS + _pixel(x, row)))
            if any_set(brightest > _ZERO):
                first, last = min(first, row), row + ROWS - 1
                break
    return first, last


@njit(error_model="numpy", fastmath=_FAST, inline="always")
def _finish(block, p, count, image, alpha, depth, background, with_depth, y, c):
    """Write `count` pixels from p on, of one strip, to row y and columns c and on."""
    for x in range(count):
        left_over = abs(block[p + LIGHT * PIXELS + x])
        image[0, y, c + x] = block[p + F0 * PIXELS + x] + left_over * background[0]
        image[1, y, c + x] = block[p + F1 * PIXELS + x] + left_over * background[1]
        image[2, y, c + x] = block[p + F2 * PIXELS + x] + left_over * background[2]
        alpha[y, c + x] = _ONE - left_over
        if with_depth:
            depth[y, c + x] = block[p + DEPTH * PIXELS + x]


@njit(error_model="numpy", inline="always")
def _leave_empty(image, alpha, depth, background, with_depth, tx, ty, width, height):
    """Background in a tile that no Gaussian meets."""
    first, last = tx * TILE, min(tx * TILE + TILE, width)
    for y in range(ty * TILE, min(ty * TILE + TILE, height)):
        for k in range(alpha.shape[0]):
            for channel in range(3):
                image[k, channel, y, first:last] = background[channel]
            alpha[k, y, first:last] = _ZERO
        if with_depth:
            depth[y, first:last] = _ZERO


@njit(error_model="numpy", inline="always")
def _ask_for(pictures, tx, ty, width, height):
    """Have the lines of a tile of pictures [_, h, w] fetched while its Gaussians are blended: writing would wait."""
    for plane in range(pictures.shape[0]):
        for y in range(ty * TILE, min(ty * TILE + TILE, height)):
            prefetch_to_write(pictures, (plane * height + y) * width + tx * TILE)


@njit(parallel=True, fastmath=_FAST, error_model="numpy", cache=True)
def composite(
    offsets, entries, splats, depths, level, prefixes, features, background, with_depth, width, height,
    image, alpha, depth,
):  # fmt: skip
    """Fill `image` [prefixes, 3, h, w], `alpha` [prefixes, h, w] and, if asked, `depth` [h, w].

    `alpha` is 1 - final transmittance; `background` [3] fills what light is left.

    `level` [n] in 1..prefixes, or None: all belong to a single prefix. Depth needs one prefix.
    """
    tiles_x = (width + TILE - 1) // TILE
    columns, rows = _lane_centres()
    for t in prange(offsets.shape[0] - 1):
        ty = t // tiles_x
        tx = t - ty * tiles_x
        if offsets[t] == offsets[t + 1]:
            _leave_empty(image, alpha, depth, background, with_depth, tx, ty, width, height)
            continue
        scratch = _scratch(prefixes * FORWARD_BLOCK)
        for k in range(prefixes):
            _start_light(scratch, k * FORWARD_BLOCK + LIGHT * PIXELS, tx, ty, width, height)
        _ask_for(image.reshape(prefixes * 3, height, width), tx, ty, width, height)
        _ask_for(alpha, tx, ty, width, height)
        last_prefix = _last_prefix(level, prefixes)
        since_check, first_row, last_row = 0, 0, TILE - 1
        for entry in range(offsets[t], offsets[t + 1]):
            i, box = entries[entry, ID], np.int64(entries[entry, BOX])
            gx, gy = splats[i, X] - f4(tx * TILE), splats[i, Y] - f4(ty * TILE)
            su, ss, sv, opacity = splats[i, U], splats[i, S], splats[i, V], splats[i, OPACITY]
            qu, qs, qv = su * _QUARTER, ss * _QUARTER, sv * _SIXTEENTH
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            z = depths[i]
            first_prefix = _first_prefix(level, i)
            for strip in range(box >> 8 & 15, (box >> 12) + 1):
                u0 = (load(columns, 0) + (f4(strip * STRIP) - gx)) * qu
                for row in range(max(box & 15, first_row) // ROWS * ROWS, min(box >> 4 & 15, last_row) + 1, ROWS):
                    dy = load(rows, 0) + (f4(row) - gy)
                    share = _alpha(u0 + dy * qs, dy * dy * qv, opacity)
                    for k in range(first_prefix, last_prefix + 1):
                        at = k * FORWARD_BLOCK + strip * STRIP_PIXELS + row * STRIP
                        before = load(scratch, at + LIGHT * PIXELS)
                        weight = share * maximum(before, lanes(_ZERO))
                        left = before - weight
                        going = left > _STOP
                        weight = select(going, weight, lanes(_ZERO))
                        store(scratch, at + LIGHT * PIXELS, select(going, left, lanes(_ZERO) - magnitude(before)))
                        store(scratch, at + F0 * PIXELS, load(scratch, at + F0 * PIXELS) + weight * c0)
                        store(scratch, at + F1 * PIXELS, load(scratch, at + F1 * PIXELS) + weight * c1)
                        store(scratch, at + F2 * PIXELS, load(scratch, at + F2 * PIXELS) + weight * c2)
                        if with_depth:
                            store(scratch, at + DEPTH * PIXELS, load(scratch, at + DEPTH * PIXELS) + weight * z)
            since_check += 1
            if since_check == _CHECK_EVERY:
                since_check = 0
                first_row, last_row = _unfinished_rows(scratch, prefixes, FORWARD_BLOCK)
                if first_row > last_row:
                    break
        across, down = width - tx * TILE, height - ty * TILE
        for k in range(prefixes):
            block = scratch[k * FORWARD_BLOCK :]
            for row in range(min(TILE, down)):
                y = ty * TILE + row
                for start in range(0, min(TILE, across), STRIP):
                    p, c = _pixel(start, row), tx * TILE + start
                    # a whole strip is a loop of known length, which becomes a few vector instructions
                    if across - start >= STRIP:
                        _finish(block, p, STRIP, image[k], alpha[k], depth, background, with_depth, y, c)
                    else:
                        _finish(block, p, across - start, image[k], alpha[k], depth, background, with_depth, y, c)


@njit(error_model="numpy", inline="always")
def _start_gradient(scratch, at, tx, ty, width, height, image, v_image):
    _start_light(scratch, at + LIGHT * PIXELS, tx, ty, width, height)
    across = width - tx * TILE
    for row in range(min(TILE, height - ty * TILE)):
        y = ty * TILE + row
        for start in range(0, min(TILE, across), STRIP):
            p, c = at + _pixel(start, row), tx * TILE + start
            for x in range(min(STRIP, across - start)):
                g0, g1, g2 = v_image[0, y, c + x], v_image[1, y, c + x], v_image[2, y, c + x]
                scratch[p + G0 * PIXELS + x] = g0
                scratch[p + G1 * PIXELS + x] = g1
                scratch[p + G2 * PIXELS + x] = g2
                done = g0 * image[0, y, c + x] + g1 * image[1, y, c + x] + g2 * image[2, y, c + x]
                scratch[p + REST * PIXELS + x] = done


@njit(error_model="numpy", inline="always")
def _add_light(scratch, at, tx, ty, width, height, alpha, v_alpha):
    """What alpha's gradient adds to the rest: dL/d(1 - alpha) times 1 - alpha."""
    across = width - tx * TILE
    for row in range(min(TILE, height - ty * TILE)):
        y = ty * TILE + row
        for start in range(0, min(TILE, across), STRIP):
            p, c = at + _pixel(start, row), tx * TILE + start
            for x in range(min(STRIP, across - start)):
                scratch[p + REST * PIXELS + x] -= (_ONE - alpha[y, c + x]) * v_alpha[y, c + x]


@njit(parallel=True, fastmath=_FAST, error_model="numpy", cache=True)
def composite_backward(
    offsets, entries, splats, level, prefixes, own, features, width, height,
    image, alpha, v_image, v_alpha, partial,
):  # fmt: skip
    """Write each entry's sums to its slot of `partial` [entries * V_COLUMNS]: no two threads share a slot.

    `v_alpha` has no prefixes where alpha has no gradient.

    `own`: the statistic columns hold the gradient of the prefix that equals the Gaussian's level, else of the last one.
    """
    tiles_x = (width + TILE - 1) // TILE
    columns, rows = _lane_centres()
    for t in prange(offsets.shape[0] - 1):
        ty = t // tiles_x
        tx = t - ty * tiles_x
        scratch = _scratch(prefixes * BACKWARD_BLOCK)
        for k in range(prefixes):
            _start_gradient(scratch, k * BACKWARD_BLOCK, tx, ty, width, height, image[k], v_image[k])
            if v_alpha.shape[0] > 0:
                _add_light(scratch, k * BACKWARD_BLOCK, tx, ty, width, height, alpha[k], v_alpha[k])
        last_prefix = _last_prefix(level, prefixes)
        since_check, first_row, last_row = 0, 0, TILE - 1
        for entry in range(offsets[t], offsets[t + 1]):
            slot = np.int64(entries[entry, SLOT])
            if first_row > last_row:
                partial[slot * V_COLUMNS : (slot + 1) * V_COLUMNS] = _ZERO
                continue
            i, box = entries[entry, ID], np.int64(entries[entry, BOX])
            gx, gy = splats[i, X] - f4(tx * TILE), splats[i, Y] - f4(ty * TILE)
            su, ss, sv, opacity = splats[i, U], splats[i, S], splats[i, V], splats[i, OPACITY]
            qu, qs, qv = su * _QUARTER, ss * _QUARTER, sv * _SIXTEENTH
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            judged = _first_prefix(level, i) if own else last_prefix
            zero = lanes(_ZERO)
            # per lane: gradients of the features; moments of alpha dL/dalpha, of its judged part, and of absolutes
            v0 = v1 = v2 = m = mu = my = muu = muy = myy = ju = jy = ax = ay = zero
            first_prefix = _first_prefix(level, i)
            for strip in range(box >> 8 & 15, (box >> 12) + 1):
                u0 = (load(columns, 0) + (f4(strip * STRIP) - gx)) * qu
                for row in range(max(box & 15, first_row) // ROWS * ROWS, min(box >> 4 & 15, last_row) + 1, ROWS):
                    dy = load(rows, 0) + (f4(row) - gy)
                    u = u0 + dy * qs
                    share = _alpha(u, dy * dy * qv, opacity)
                    beyond = _ONE / (_ONE - share)
                    v_share = v_judged = zero
                    for k in range(first_prefix, last_prefix + 1):
                        at = k * BACKWARD_BLOCK + strip * STRIP_PIXELS + row * STRIP
                        before = load(scratch, at + LIGHT * PIXELS)
                        weight = share * maximum(before, zero)
                        left = before - weight
                        going = left > _STOP
                        weight = select(going, weight, zero)
                        store(scratch, at + LIGHT * PIXELS, select(going, left, zero - magnitude(before)))
                        g0 = load(scratch, at + G0 * PIXELS)
                        g1 = load(scratch, at + G1 * PIXELS)
                        g2 = load(scratch, at + G2 * PIXELS)
                        q = g0 * c0 + g1 * c1 + g2 * c2
                        rest = load(scratch, at + REST * PIXELS) - weight * q
                        store(scratch, at + REST * PIXELS, rest)
                        v0 = v0 + weight * g0
                        v1 = v1 + weight * g1
                        v2 = v2 + weight * g2
                        part = select(going, before * q - rest * beyond, zero)
                        v_share = v_share + part
                        if k == judged:
                            v_judged = part
                    held = select(share < _ALPHA_MAX, share, zero)
                    v_share, v_judged = v_share * held, v_judged * held
                    by_u, by_y = v_share * u, v_share * dy
                    m = m + v_share
                    mu = mu + by_u
                    my = my + by_y
                    muu = muu + by_u * u
                    muy = muy + by_u * dy
                    myy = myy + by_y * dy
                    ju = ju + v_judged * u
                    jy = jy + v_judged * dy
                    size = magnitude(v_judged)
                    ax = ax + size * magnitude(u)
                    ay = ay + size * magnitude(u * ss + dy * (_QUARTER * sv))
            # u is quartered: 4 u = U dx + S dy, (d/dx, d/dy)((4 u)^2 + v^2) = 8 (U u, S u + V dy / 4)
            store_totals(
                partial, slot * V_COLUMNS,
                (
                    v0, v1, v2, m, mu * _FOUR, my, muu * (_FOUR * _FOUR), muy * _FOUR, myy, ju * _FOUR, jy,
                    ax * _EIGHT, ay * _EIGHT, zero, zero, zero,
                ),
            )  # fmt: skip
            since_check += 1
            if since_check == _CHECK_EVERY:
                since_check = 0
                first_row, last_row = _unfinished_rows(scratch, prefixes, BACKWARD_BLOCK)
