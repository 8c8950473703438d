"""The frequency term against numpy's FFT in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from freqgs_plugin.functional.spectrum import (
    band_energy,
    fast_size,
    magnitude,
    magnitude_distance,
    magnitude_distance_to,
    radial_bands,
    radial_energy,
)

SHAPES = [(1, 3, 1, 1), (1, 3, 1, 8), (1, 3, 9, 1), (2, 3, 8, 8), (1, 3, 7, 9), (1, 1, 16, 15), (3, 3, 15, 16), (7, 6)]


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def full_plane_distance(a, b):
    return np.mean(np.abs(np.abs(np.fft.fft2(a.numpy())) - np.abs(np.fft.fft2(b.numpy()))))


@pytest.mark.parametrize("shape", SHAPES)
def test_distance_is_that_of_the_full_plane(shape):
    a, b = noise(*shape), noise(*shape, seed=1)
    expected = full_plane_distance(a, b)
    assert magnitude_distance(a, b).item() == pytest.approx(expected, rel=1e-10)
    scaled = expected / np.sqrt(shape[-1] * shape[-2])
    assert magnitude_distance(a, b, norm="ortho").item() == pytest.approx(scaled, rel=1e-10)


@settings(max_examples=40, deadline=None)
@given(shape=st.tuples(*[st.integers(1, 4)] * 2, *[st.integers(1, 24)] * 2), seed=st.integers(0, 99))
def test_distance_at_any_shape(shape, seed):
    a, b = noise(*shape, seed=seed), noise(*shape, seed=seed + 100)
    assert magnitude_distance(a, b).item() == pytest.approx(full_plane_distance(a, b), rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_both_ways_to_the_magnitude_agree(shape):
    image = noise(*shape)
    expected = np.abs(np.fft.rfft2(image.numpy()))
    np.testing.assert_allclose(magnitude(image).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(magnitude(image.requires_grad_()).detach().numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients(shape):
    a, b = noise(*shape).requires_grad_(), noise(*shape, seed=1)
    assert torch.autograd.gradcheck(lambda x: magnitude_distance(x, b), a, fast_mode=True)
    assert torch.autograd.gradcheck(lambda x: magnitude_distance(b, x), a, fast_mode=True)
    assert torch.autograd.gradcheck(magnitude, a, fast_mode=True)
    compiled = torch.autograd.grad(magnitude_distance(a, b), a)[0]
    plain = torch.autograd.grad((torch.fft.fft2(a).abs() - torch.fft.fft2(b).abs()).abs().mean(), a)[0]
    torch.testing.assert_close(compiled, plain)


def test_gradient_carries_the_factor_from_above():
    a, b = noise(1, 3, 9, 8).requires_grad_(), noise(1, 3, 9, 8, seed=1)
    once = torch.autograd.grad(magnitude_distance(a, b), a)[0]
    torch.testing.assert_close(torch.autograd.grad(-3 * magnitude_distance(a, b), a)[0], -3 * once)


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (9, 7), (480, 319)])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("grad_target", [False, True])
def test_gradient_is_finite_at_constant_images(size, value, grad_target):
    a = torch.full((1, 3, *size), value, requires_grad=True)
    b = noise(1, 3, *size, dtype=torch.float32).requires_grad_(grad_target)
    magnitude_distance(a, b).backward()
    assert torch.isfinite(a.grad).all()
    if value == 0:
        assert (a.grad == 0).all()


@pytest.mark.parametrize("size", [(24, 32), (25, 33)])
def test_equal_images_and_shifted_images_have_distance_zero(size):
    image = noise(1, 3, *size)
    assert magnitude_distance(image, image).item() == 0
    assert magnitude_distance(image, image.roll((5, 3), (-2, -1))).item() < 1e-12


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("value", [1.0, 1000.0])  # DC 3e7 would overflow float16
def test_half_precision_is_computed_in_float32(dtype, value):
    a, b = value * noise(1, 3, 64, 48).to(dtype), value * noise(1, 3, 64, 48, seed=1).to(dtype)
    a.requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        distance = magnitude_distance(a, b)
    assert distance.dtype == torch.float32
    expected = full_plane_distance(a.detach().double(), b.double())
    assert distance.item() == pytest.approx(expected, rel=1e-5)
    distance.backward()
    assert a.grad.dtype == dtype and torch.isfinite(a.grad).all()


def test_float32_is_close_to_float64_at_image_size():
    a, b = noise(1, 3, 321, 240), noise(1, 3, 321, 240, seed=1)
    assert magnitude_distance(a.float(), b.float()).item() == pytest.approx(full_plane_distance(a, b), rel=1e-5)


def test_non_contiguous_images():
    a, b = noise(9, 11, 3).permute(2, 0, 1), noise(3, 9, 11, seed=1)
    assert magnitude_distance(a, b).item() == pytest.approx(full_plane_distance(a, b), rel=1e-10)


@pytest.mark.parametrize("counts", [(1,), (1, 1), (2, 1, 3)])
@pytest.mark.parametrize("channels", [1, 3])
def test_several_images_count_as_their_concatenation(counts, channels):
    images = [noise(n, channels, 9, 12, seed=i).requires_grad_() for i, n in enumerate(counts)]
    target = magnitude(noise(sum(counts), channels, 9, 12, seed=9))
    together, apart = magnitude_distance_to(torch.cat(images), target), magnitude_distance_to(images, target)
    assert apart.item() == together.item()
    for one, other in zip(torch.autograd.grad(together, images), torch.autograd.grad(apart, images), strict=True):
        assert torch.equal(one, other)
    plain = magnitude_distance_to(images, target.requires_grad_())
    assert plain.item() == pytest.approx(apart.item(), rel=1e-12)


@pytest.mark.parametrize("shape", [(1, 3, 7, 9), (3, 1, 5, 8), (2, 3, 1, 1)])
@pytest.mark.parametrize("size", [(7, 9), (9, 10), (8, 15)])
def test_a_larger_transform_sees_zeros_beyond_the_image(shape, size):
    a, b = noise(*shape).requires_grad_(), noise(*shape, seed=1)
    padding = (0, size[1] - shape[-1], 0, size[0] - shape[-2])
    larger_a, larger_b = torch.nn.functional.pad(a, padding), torch.nn.functional.pad(b, padding)
    torch.testing.assert_close(magnitude(b, size), magnitude(larger_b), rtol=0, atol=1e-12)
    distance, expected = magnitude_distance_to(a, magnitude(b, size), size=size), magnitude_distance(larger_a, larger_b)
    plain = magnitude_distance_to(a, magnitude(b, size).requires_grad_(), size=size)
    assert distance.item() == pytest.approx(expected.item(), rel=1e-12) == plain.item()
    gradients = [torch.autograd.grad(value, a)[0] for value in (distance, expected, plain)]
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=1e-12)
    torch.testing.assert_close(gradients[0], gradients[2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("norm", ["backward", "ortho"])
def test_a_weight_scales_value_and_gradient(norm):
    a, target = noise(1, 3, 9, 12).requires_grad_(), magnitude(noise(1, 3, 9, 12, seed=1))
    for kept in (target, target.clone().requires_grad_()):
        plain, weighted = magnitude_distance_to(a, kept, norm), magnitude_distance_to(a, kept, norm, weight=-0.3)
        assert weighted.item() == pytest.approx(-0.3 * plain.item(), rel=1e-12)
        gradients = [torch.autograd.grad(value, a)[0] for value in (weighted, plain)]
        torch.testing.assert_close(gradients[0], -0.3 * gradients[1])


def test_fast_sizes_have_small_prime_factors():
    assert fast_size(319, 480) == (320, 480) and fast_size(840, 1297) == (840, 1300) == fast_size(840, 1300)
    assert fast_size(1, 127) == (1, 128)


def test_a_transform_smaller_than_the_image_is_refused():
    with pytest.raises(ValueError, match=r"size \(8, 7\) would cut a 8x8 image"):
        magnitude(noise(1, 3, 8, 8), (8, 7))


def test_wrong_target_shape_is_named():
    with pytest.raises(ValueError, match=r"\(1, 3, 8, 5\), got \(1, 3, 8, 4\)"):
        magnitude_distance_to(noise(1, 3, 8, 8), noise(1, 3, 8, 4))


@pytest.mark.parametrize("size", [(1, 1), (8, 9), (33, 20)])
@pytest.mark.parametrize("levels", [1, 2, 4])
def test_radial_bands_are_octaves(size, levels):
    rows, columns = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    radius = np.sqrt(rows**2 + columns**2)
    expected = np.ones(radius.shape, int)
    for k in range(2, levels + 1):
        expected[radius >= 2.0 ** (k - levels - 2)] = k
    np.testing.assert_array_equal(radial_bands(*size, levels).numpy(), expected)


@pytest.mark.parametrize("size", [(1, 1), (8, 9), (33, 20)])
def test_radial_energies_sum_to_the_mean_square(size):
    image = noise(2, 3, *size)
    assert radial_energy(image, 4).sum().item() == pytest.approx(image.square().mean().item(), rel=1e-12)


@pytest.mark.parametrize("frequency, level", [(0.4, 4), (0.2, 3), (0.1, 2), (0.02, 1)])
def test_a_wave_lies_in_its_band(frequency, level):
    wave = torch.cos(2 * torch.pi * frequency * torch.arange(100, dtype=torch.float64)).expand(1, 1, 100, 100)
    energy = radial_energy(wave, 4)
    assert energy[level - 1].item() == pytest.approx(0.5, rel=1e-9)
    assert energy.sum().item() == pytest.approx(0.5, rel=1e-9)


def test_band_energy_of_flat_and_of_fine_images():
    flat = band_energy(torch.full((1, 3, 32, 32), 0.5, dtype=torch.float64), 3)
    torch.testing.assert_close(flat, torch.tensor([0.25, 0, 0], dtype=torch.float64))
    checkers = (torch.arange(32)[:, None] + torch.arange(32)) % 2 * 1.0  # nothing of it survives one reduction
    torch.testing.assert_close(band_energy(checkers[None, None], 3), torch.tensor([0.25, 0, 0.25]), atol=1e-6, rtol=0)
