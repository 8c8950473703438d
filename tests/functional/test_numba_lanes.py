"""Vectors in compiled kernels against numpy, on numbers that include both signs and ties."""

import numpy as np
import pytest

from freqgs_plugin.functional.numba_lanes import (
    LANES,
    TOTALS,
    add_row,
    any_set,
    lanes,
    load,
    magnitude,
    maximum,
    minimum,
    select,
    store,
    store_totals,
)
from freqgs_plugin.functional.numba_threads import njit

f4 = np.float32


@njit(error_model="numpy")
def _apply(a, b, number, out):
    for i in range(0, len(a), LANES):
        x, y = load(a, i), load(b, i)
        store(out[0], i, x + y)
        store(out[1], i, x - number)
        store(out[2], i, number * y)
        store(out[3], i, x / y)
        store(out[4], i, minimum(x, y))
        store(out[5], i, maximum(x, y))
        store(out[6], i, magnitude(x))
        store(out[7], i, select(x > y, x, lanes(number)))
        store(out[8], i, select(x >= y, x, lanes(number)))
        store(out[9], i, select(x < number, x, y))


@njit(error_model="numpy")
def _any_above(a, bound):
    found = False
    for i in range(0, len(a), LANES):
        found |= any_set(load(a, i) > bound)
    return found


@njit(error_model="numpy")
def _totals(a, out, sums):
    v = LANES
    rows = (
        load(a, 0), load(a, v), load(a, 2 * v), load(a, 3 * v), load(a, 4 * v), load(a, 5 * v), load(a, 6 * v),
        load(a, 7 * v), load(a, 8 * v), load(a, 9 * v), load(a, 10 * v), load(a, 11 * v), load(a, 12 * v),
        load(a, 13 * v), load(a, 14 * v), load(a, 15 * v),
    )  # fmt: skip
    store_totals(out, 3, rows)
    add_row(sums, out, 3)


@pytest.fixture(params=[np.float32, np.float64])
def pair(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=(2, 4 * LANES)).astype(request.param)
    b[::5] = a[::5]
    return a, b


def test_each_operation_is_numpys(pair: tuple[np.ndarray, np.ndarray]):
    a, b = pair
    number = a.dtype.type(0.25)
    out = np.zeros((10, len(a)), a.dtype)
    _apply(a, b, number, out)
    expected = [
        a + b, a - number, number * b, a / b, np.minimum(a, b), np.maximum(a, b), np.abs(a),
        np.where(a > b, a, number), np.where(a >= b, a, number), np.where(a < number, a, b),
    ]  # fmt: skip
    np.testing.assert_allclose(out, expected, rtol=8 * np.finfo(a.dtype).eps)


@pytest.mark.parametrize("position", [0, LANES - 1, 2 * LANES + 3])
@pytest.mark.parametrize("scalar", [np.float32, np.float64])
def test_any_set_sees_every_lane(position: int, scalar: type):
    a = np.ones(4 * LANES, scalar)
    assert not _any_above(a, scalar(1))
    a[position] = 2
    assert _any_above(a, scalar(1))


def test_totals_are_in_their_places_and_nowhere_else():
    a = np.random.default_rng(1).integers(-99, 99, (TOTALS, LANES)).astype(f4)
    out, sums = np.full(TOTALS + 5, f4(7)), np.arange(TOTALS, dtype=np.float64)
    _totals(a.ravel(), out, sums)
    np.testing.assert_array_equal(out[3:-2], a.sum(1))
    np.testing.assert_array_equal(np.delete(out, slice(3, 3 + TOTALS)), f4(7))
    np.testing.assert_array_equal(sums, np.arange(TOTALS) + a.sum(1))
