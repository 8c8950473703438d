"""Pyramids against OpenCV, hand-written float64 numpy, and their own laws."""

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from freqgs_plugin.functional.pyramid import collapse, expand, laplacian, low_pass, max_levels, reduce

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (1, 7), (9, 1), (2, 5), (3, 3), (3, 4), (5, 5), (16, 16), (17, 30), (33, 48)]
sides = st.integers(1, 40)


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def to_hwc(image):
    return np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())


@pytest.mark.parametrize("size", SIZES)
def test_reduce_is_opencv_pyrdown(size):
    image = noise(1, 3, *size)
    expected = cv2.pyrDown(to_hwc(image), borderType=cv2.BORDER_REFLECT_101)
    actual = to_hwc(reduce(image))
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize("size", [(21, 34), (34, 21)])
def test_reduce_is_blur_then_every_second_pixel(size):
    image = noise(1, 3, *size)
    taps = np.array([1, 4, 6, 4, 1]) / 16
    blurred = cv2.sepFilter2D(to_hwc(image), -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    np.testing.assert_allclose(to_hwc(reduce(image)), blurred[::2, ::2], atol=1e-12)


def test_convention_reduce_rounds_up_and_low_pass_keeps_the_size():
    image = noise(2, 3, 13, 7)
    assert reduce(image, 2).shape == (2, 3, 4, 2)
    assert low_pass(image, 2).shape == image.shape
    assert torch.equal(reduce(image, 0), image) and torch.equal(low_pass(image, 0), image)
    torch.testing.assert_close(reduce(image, 3), reduce(reduce(reduce(image))))


@pytest.mark.parametrize("size", SIZES)
def test_constants_stay_constant(size):
    image = torch.full((1, 3, *size), 0.37, dtype=torch.float64)
    for result in (reduce(image, 3), expand(reduce(image), size), low_pass(image, 3)):
        torch.testing.assert_close(result, torch.full_like(result, 0.37))


@pytest.mark.parametrize("size", [(16, 16), (17, 31), (32, 9)])
def test_expand_is_opencv_pyrup_inside(size):
    small = noise(1, 3, (size[0] + 1) // 2, (size[1] + 1) // 2)
    expected = cv2.pyrUp(to_hwc(small), dstsize=size[::-1])
    inside = (slice(2, -2), slice(2, -2))  # OpenCV repeats the last small pixel where we mirror
    np.testing.assert_allclose(to_hwc(expand(small, size))[inside], expected[inside], atol=1e-12)


def test_expand_is_the_adjoint_of_reduce_inside():
    small, large = torch.zeros(1, 1, 12, 12, dtype=torch.float64), noise(1, 1, 24, 24)
    small[..., 3:9, 3:9] = noise(1, 1, 6, 6, seed=1)
    torch.testing.assert_close((reduce(large) * small).sum(), (large * expand(small, (24, 24))).sum() / 4)


def test_expand_names_the_size_it_needs():
    with pytest.raises(ValueError, match=r"\(5, 4\).*\(4, 4\)"):
        expand(noise(1, 3, 4, 4), (9, 8))


@pytest.mark.parametrize("width", [1, 2, 3, 10, 64, 65])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 1e-6)])
def test_collapse_inverts_laplacian_at_every_height(width, dtype, tolerance):
    for height in range(1, 66):
        image = noise(1, 2, height, width, seed=height, dtype=dtype)
        bands = laplacian(image, 5)
        assert [tuple(b.shape[-2:]) for b in bands[-2:]] == [((height + 1) // 2, (width + 1) // 2), (height, width)]
        torch.testing.assert_close(collapse(bands), image, atol=tolerance, rtol=0)


@settings(max_examples=40, deadline=None)
@given(height=sides, width=sides, levels=st.integers(1, 6), seed=st.integers(0, 99))
def test_collapse_inverts_laplacian(height, width, levels, seed):
    image = noise(1, 1, height, width, seed=seed)
    torch.testing.assert_close(collapse(laplacian(image, levels)), image, atol=1e-13, rtol=0)


@settings(max_examples=30, deadline=None)
@given(height=sides, width=sides, times=st.integers(0, 4), factor=st.floats(-3, 3))
def test_linear(height, width, times, factor):
    a, b = noise(1, 2, height, width), noise(1, 2, height, width, seed=1)
    for operator in (reduce, low_pass):
        together = operator(a + factor * b, times)
        torch.testing.assert_close(together, operator(a, times) + factor * operator(b, times), atol=1e-12, rtol=0)


def test_first_bands_alone_give_the_gaussian_pyramid():
    image = noise(1, 3, 37, 50)
    bands = laplacian(image, 4)
    for k in range(1, 5):
        torch.testing.assert_close(collapse(bands[:k]), reduce(image, 4 - k))


@pytest.mark.parametrize("size", [(2, 2), (16, 24), (8, 32)])
def test_low_pass_of_even_sizes_is_opencv_resize(size):
    image = noise(1, 3, *size, dtype=torch.float32)
    small = cv2.resize(to_hwc(image), (size[1] // 2, size[0] // 2), interpolation=cv2.INTER_LINEAR)
    expected = cv2.resize(small.reshape(size[0] // 2, size[1] // 2, 3), size[::-1], interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(to_hwc(low_pass(image, 1)), expected, atol=1e-5)


def test_low_pass_halves_as_torch_bilinear_without_antialiasing():
    image = noise(1, 3, 22, 15)
    halved = F.interpolate(image, scale_factor=0.5, mode="bilinear", align_corners=False)
    doubled = F.interpolate(halved, scale_factor=2, mode="bilinear", align_corners=False)
    result = low_pass(image, 1)
    torch.testing.assert_close(result[..., :14], doubled)
    torch.testing.assert_close(result[..., 14], doubled[..., 13])


@pytest.mark.parametrize("side", [64, 65, 71, 127])
def test_low_pass_does_not_move_content(side):
    ramp = torch.linspace(0, 1, side, dtype=torch.float64).expand(1, 1, side, side)
    difference = (low_pass(ramp, 2) - ramp)[..., 8:-8] * (side - 1)  # in pixels
    assert difference.abs().max() < 1e-9


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 4)])
def test_gradients(size):
    image = noise(1, 2, *size).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: reduce(x, 2), image)
    assert torch.autograd.gradcheck(lambda x: low_pass(x, 2), image)
    assert torch.autograd.gradcheck(lambda x: tuple(laplacian(x, 3)), image)


@pytest.mark.parametrize("size, levels", [((15, 100), 1), ((16, 100), 1), ((32, 100), 2), ((480, 319), 5), ((1, 1), 1)])
def test_max_levels(size, levels):
    assert max_levels(*size) == levels == max_levels(*size[::-1])


def test_a_pyramid_needs_a_level():
    with pytest.raises(ValueError, match="at least 1 level, got 0"):
        laplacian(noise(1, 1, 4, 4), 0)
