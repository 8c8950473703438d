"""Compiled depth order and tile lists.

Each tile of TILE x TILE pixels gets the Gaussians whose ellipse {alpha >= ALPHA_MIN} meets its pixel centres, front to
back, equal depths by row. Each entry carries a box: which rows and which 8-pixel strips of the tile the ellipse meets.
"""

import math

import numpy as np

from freqgs_plugin.functional.numba_threads import njit, prange
from freqgs_plugin.rendering.base import MAX_ENTRIES
from freqgs_plugin.rendering.numba_projection import OPACITY, REACH_X, REACH_Y, S, U, V, X, Y

TILE = 16
STRIP = 8
# columns of an entry of the tile lists
ID, BOX, SLOT = range(3)
_RADIX_BITS = 11
_SLACK = 1e-3
"""px by which spans are widened, so that rounding never drops a pixel at ALPHA_MIN"""


@njit(cache=True)
def depth_order(depths, splats):
    """Rows of drawn Gaussians (opacity > 0) by increasing depth, equal depths by row: a stable radix sort."""
    n = 0
    rows = np.empty(depths.shape[0], np.int32)
    for i in range(depths.shape[0]):
        if splats[i, OPACITY] > 0:
            rows[n] = i
            n += 1
    rows = rows[:n]
    bits = depths.view(np.uint32)
    swap = np.empty(n, np.int32)
    buckets = 1 << _RADIX_BITS
    for shift in range(0, 32, _RADIX_BITS):
        start = np.zeros(buckets + 1, np.int64)
        for i in rows:
            start[((bits[i] >> np.uint32(shift)) & np.uint32(buckets - 1)) + 1] += 1
        for k in range(buckets):
            start[k + 1] += start[k]
        for i in rows:
            k = (bits[i] >> np.uint32(shift)) & np.uint32(buckets - 1)
            swap[start[k]] = i
            start[k] += 1
        rows, swap = swap, rows
    return rows


@njit(error_model="numpy", inline="always")
def _x_span(slope, extreme, sheared, rx, ry, inverse_ry, low, high):
    """Least and greatest dx on the ellipse between rows dy = low and high (both within or nearest to it).

    At offset dy the ellipse is `sheared` * sqrt(1 - (dy / ry)^2) px to either side of the line dx = slope dy; dx is
    greatest at dy = extreme.
    """
    if low <= -abs(extreme) and abs(extreme) <= high:
        return -rx, rx
    low, high = min(max(low, -ry), ry), min(max(high, -ry), ry)
    low_half = sheared * math.sqrt(max(0.0, 1.0 - (low * inverse_ry) * (low * inverse_ry)))
    high_half = sheared * math.sqrt(max(0.0, 1.0 - (high * inverse_ry) * (high * inverse_ry)))
    greatest = max(slope * low + low_half, slope * high + high_half)
    least = min(slope * low - low_half, slope * high - high_half)
    if low <= extreme <= high:
        greatest = rx
    if low <= -extreme <= high:
        least = -rx
    return least, greatest


@njit(parallel=True, error_model="numpy", cache=True)
def tile_lists(order, splats, width, height, num_rows, bands):
    """Tile lists of the Gaussians in `order`, made in `bands` parallel parts.

    Returns:
        offsets [tiles + 1] into the lists; entries [entries, 3]: the Gaussian's row, its box in the tile (first row,
        last row, first and last strip, 4 bits each), its slot; first and count [num_rows] of each Gaussian's slots,
        which follow each other by row. Where there would be more than MAX_ENTRIES, the last offset is their number, and
        no list is made.
    """
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    n = order.shape[0]
    # rows of pixels, and where a Gaussian's rows of tiles begin in `spans`
    bottom, top = np.zeros(n, np.int32), np.full(n, -1, np.int32)
    row_start = np.zeros(n + 1, np.int64)
    for k in range(n):
        i = order[k]
        low = max(np.ceil(splats[i, Y] - splats[i, REACH_Y] - 0.5 - _SLACK), 0.0)
        high = min(np.floor(splats[i, Y] + splats[i, REACH_Y] - 0.5 + _SLACK), height - 1.0)
        rows = 0
        if low <= high:
            bottom[k], top[k] = int(low), int(high)
            rows = top[k] // TILE - bottom[k] // TILE + 1
        row_start[k + 1] = row_start[k] + rows

    # columns of pixels per Gaussian and row of tiles
    spans = np.empty((row_start[n], 2), np.int32)
    count = np.zeros(num_rows, np.int32)
    for k in prange(n):
        i = order[k]
        x, y = np.float64(splats[i, X]), np.float64(splats[i, Y])
        u, s, v = np.float64(splats[i, U]), np.float64(splats[i, S]), np.float64(splats[i, V])
        rx, ry = np.float64(splats[i, REACH_X]) + 1e-30, np.float64(splats[i, REACH_Y]) + 1e-30
        # alpha = ALPHA_MIN where (U dx + S dy)^2 + V dy^2 = V ry^2
        sheared = math.sqrt(v) * ry / u
        slope, extreme, inverse_ry = -s / u, -u * s / (v + s * s) * rx, 1.0 / ry
        total = 0
        for r in range(row_start[k], row_start[k + 1]):
            first_row = (bottom[k] // TILE + r - row_start[k]) * TILE + 0.5 - y
            least, greatest = _x_span(slope, extreme, sheared, rx, ry, inverse_ry, first_row, first_row + TILE - 1.0)
            low = max(np.ceil(x + least - 0.5 - _SLACK), 0.0)
            high = min(np.floor(x + greatest - 0.5 + _SLACK), width - 1.0)
            spans[r, 0], spans[r, 1] = 0, -1
            if low <= high:
                spans[r, 0], spans[r, 1] = int(low), int(high)
                total += spans[r, 1] // TILE - spans[r, 0] // TILE + 1
        count[i] = total
    first = np.zeros(num_rows, np.int64)
    length = 0
    for i in range(num_rows):
        first[i] = length
        length += count[i]

    offsets = np.zeros(tiles_x * tiles_y + 1, np.int64)
    if length > MAX_ENTRIES:
        offsets[-1] = length
        return offsets, np.empty((0, 3), np.int32), first, count

    # threads take bands of tile rows: each list is filled by one thread, in depth order
    bands = min(bands, tiles_y)
    for band in prange(bands):
        low, high = band * tiles_y // bands, (band + 1) * tiles_y // bands
        for k in range(n):
            begin = bottom[k] // TILE
            for ty in range(max(begin, low), min(begin + row_start[k + 1] - row_start[k], high)):
                r = row_start[k] + ty - begin
                if spans[r, 0] <= spans[r, 1]:
                    for tx in range(spans[r, 0] // TILE, spans[r, 1] // TILE + 1):
                        offsets[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        offsets[t + 1] += offsets[t]

    cursor = offsets[:-1].copy()
    # one array: with three, the writes to hundreds of lists at a time would not stay in the first-level cache
    entries = np.empty((length, 3), np.int32)
    for band in prange(bands):
        low, high = band * tiles_y // bands, (band + 1) * tiles_y // bands
        for k in range(n):
            begin = bottom[k] // TILE
            end = begin + row_start[k + 1] - row_start[k]
            if end <= low or begin >= high:
                continue
            i = order[k]
            slot = first[i]
            for ty in range(begin, end):
                r = row_start[k] + ty - begin
                if spans[r, 0] > spans[r, 1]:
                    continue
                if ty < low or ty >= high:
                    slot += spans[r, 1] // TILE - spans[r, 0] // TILE + 1
                    continue
                rows = max(bottom[k] - ty * TILE, 0) | min(top[k] - ty * TILE, TILE - 1) << 4
                for tx in range(spans[r, 0] // TILE, spans[r, 1] // TILE + 1):
                    strip_low = max(spans[r, 0] - tx * TILE, 0) // STRIP
                    strip_high = min(spans[r, 1] - tx * TILE, TILE - 1) // STRIP
                    t = ty * tiles_x + tx
                    entry = entries[cursor[t]]
                    entry[ID], entry[SLOT] = i, slot
                    entry[BOX] = rows | strip_low << 8 | strip_high << 12
                    cursor[t] += 1
                    slot += 1
    return offsets, entries, first, count
