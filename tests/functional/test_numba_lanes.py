"""Vectors in compiled kernels against numpy, on numbers that include both signs and ties."""

import numpy as np
import pytest

from freqgs_plugin.functional.numba_lanes import (
    LANES,
    any_set,
    lanes,
    load,
    magnitude,
    maximum,
    minimum,
    select,
    store,
    total,
)
from freqgs_plugin.functional.numba_threads import njit


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
def _total_and_any(a, bound):
    sums = lanes(a.dtype.type(0))
    found = False
    for i in range(0, len(a), LANES):
        sums = sums + load(a, i)
        found |= any_set(load(a, i) > bound)
    return total(sums), found


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
def test_total_and_any_see_every_lane(position: int, scalar: type):
    a = np.ones(4 * LANES, scalar)
    assert _total_and_any(a, scalar(1)) == (4 * LANES, False)
    a[position] = 2
    assert _total_and_any(a, scalar(1)) == (4 * LANES + 1, True)
