"""SSIM against pytorch_msssim, scikit-image and a hand-written float64 version; clamping; L1."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pytorch_msssim import ssim as reference_ssim
from skimage.metrics import structural_similarity

from freqgs_plugin.functional import image_loss
from freqgs_plugin.functional.image_loss import image_distance, prepare, ssim


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def pair(*shape, dtype=torch.float64):
    a = noise(*shape, dtype=dtype)
    return a, 0.7 * a + 0.3 * noise(*shape, seed=1, dtype=dtype)


def slow_ssim(a, b):
    """Window by window, as the definition says."""
    height, width = a.shape[-2:]
    rows, columns = (max(n for n in (1, 3, 5, 7, 9, 11) if n <= side) for side in (height, width))
    weights = np.outer(*(np.exp(-((np.arange(n) - n // 2) ** 2) / 4.5) for n in (rows, columns)))
    weights /= weights.sum()
    values = []
    for plane_a, plane_b in zip(a.reshape(-1, height, width), b.reshape(-1, height, width), strict=True):
        for i in range(height - rows + 1):
            for j in range(width - columns + 1):
                x, y = plane_a[i : i + rows, j : j + columns], plane_b[i : i + rows, j : j + columns]
                mx, my = (weights * x).sum(), (weights * y).sum()
                vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
                vxy = (weights * (x - mx) * (y - my)).sum()
                luminance = (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
                values.append(luminance * (2 * vxy + 9e-4) / (vx + vy + 9e-4))
    return np.mean(values)


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 2), (1, 30), (30, 1), (2, 2), (3, 12), (10, 10), (11, 11), (12, 43), (50, 13)][::1]
)
def test_ssim_is_its_definition(size):
    a, b = pair(2, 3, *size)
    expected = slow_ssim(a.numpy(), b.numpy())
    assert ssim(a, b).item() == pytest.approx(expected, abs=1e-12)
    assert image_loss._ssim_by_convolution(a, b).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("size", [(11, 11), (11, 64), (33, 42), (32, 10 + 32), (97, 120), (480, 319)])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-5), (torch.float64, 1e-6)])
def test_ssim_and_gradient_equal_pytorch_msssim(size, dtype, tolerance):
    # pytorch_msssim rounds its window to float32 in every dtype
    a, b = pair(1, 3, *size, dtype=dtype)
    a.requires_grad_()
    ours, theirs = ssim(a, b), reference_ssim(a, b, data_range=1.0)
    assert ours.item() == pytest.approx(theirs.item(), abs=tolerance)
    gradient, expected = torch.autograd.grad(ours, a)[0], torch.autograd.grad(theirs, a)[0]
    torch.testing.assert_close(gradient, expected, rtol=0, atol=tolerance * expected.abs().max().item())


def test_ssim_is_scikit_image_inside():
    a, b = pair(1, 1, 40, 37)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "full": True}
    _, full = structural_similarity(a[0, 0].numpy(), b[0, 0].numpy(), **options)
    assert ssim(a, b).item() == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-10)


@pytest.mark.parametrize("size", [(1, 1), (2, 13), (7, 6), (12, 11), (14, 15)])
def test_gradients(size):
    a, b = pair(1, 2, *size)
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a, fast_mode=True)
    assert torch.autograd.gradcheck(lambda x: ssim(b, x), a, fast_mode=True)
    assert torch.autograd.gradcheck(lambda x: image_distance(x, b, 0.2), a, fast_mode=True)
    assert torch.autograd.gradcheck(lambda x, y: ssim(x, y), (a, b.requires_grad_()), fast_mode=True)


def test_compiled_gradient_is_that_of_convolutions():
    a, b = pair(2, 3, 70, 45)
    a.requires_grad_()
    expected = torch.autograd.grad(-2 * image_loss._ssim_by_convolution(a, b), a)[0]
    torch.testing.assert_close(torch.autograd.grad(-2 * ssim(a, b), a)[0], expected)


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 99))
def test_ssim_laws(height, width, seed):
    a, b = noise(1, 3, height, width, seed=seed), noise(1, 3, height, width, seed=seed + 100)
    assert ssim(a, a).item() == pytest.approx(1, abs=1e-12)
    assert ssim(a, b).item() == pytest.approx(ssim(b, a).item(), abs=1e-12)
    assert -1 <= ssim(a, b).item() <= 1
    assert ssim(a.flip(-1), b.flip(-1)).item() == pytest.approx(ssim(a, b).item(), abs=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (5, 20), (40, 30)])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0, -40.0, 1e3])
def test_finite_at_constant_and_far_images(size, value):
    for target in (torch.zeros(1, 3, *size), torch.full((1, 3, *size), value), noise(1, 3, *size, dtype=torch.float32)):
        a = torch.full((1, 3, *size), value, requires_grad=True)
        distance = image_distance(a, target, 0.2)
        distance.backward()
        assert torch.isfinite(distance) and torch.isfinite(a.grad).all()


def test_non_contiguous_and_half_precision_images():
    a, b = pair(20, 24, 3)
    planes = [image.permute(2, 0, 1)[None] for image in (a, b)]
    expected = ssim(planes[0].contiguous(), planes[1].contiguous()).item()
    assert ssim(*planes).item() == pytest.approx(expected, abs=1e-14)
    half = ssim(planes[0].bfloat16(), planes[1].bfloat16())
    assert half.dtype == torch.float32 and half.item() == pytest.approx(expected, abs=0.01)


def test_sizes_must_agree():
    # without the shape annotations' own check, which only tests run
    with pytest.raises((ValueError, TypeError)):
        ssim(noise(1, 3, 20, 20), noise(1, 3, 20, 21))


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_image_distance_is_the_weighted_sum(weight):
    a, b = pair(1, 3, 23, 18)
    expected = (1 - weight) * np.abs(a.numpy() - b.numpy()).mean() + weight * (1 - slow_ssim(a.numpy(), b.numpy()))
    assert image_distance(a, b, weight).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_values_are_the_same_without_a_gradient(weight):
    a, b = pair(1, 3, 23, 18)
    assert torch.equal(image_distance(a, b, weight), image_distance(a.clone().requires_grad_(), b, weight).detach())


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
def test_a_weight_scales_value_and_gradient(ssim_weight):
    a, b = pair(1, 3, 20, 17)
    a.requires_grad_()
    for target in (b, b.clone().requires_grad_()):
        plain, weighted = image_distance(a, target, ssim_weight), image_distance(a, target, ssim_weight, weight=-0.3)
        assert weighted.item() == pytest.approx(-0.3 * plain.item(), rel=1e-12)
        gradients = [torch.autograd.grad(value, a)[0] for value in (weighted, plain)]
        torch.testing.assert_close(gradients[0], -0.3 * gradients[1])


def test_weight_zero_does_not_compute_ssim(monkeypatch):
    monkeypatch.setattr(image_loss, "_compiled_sums", lambda *_: pytest.fail("computed"))
    image_distance(*pair(1, 3, 12, 12), 0.0)


@pytest.mark.parametrize(
    "mode, values, gradient",
    [
        ("none", [-2.0, 0.25, 0.9, 3.0], [1, 1, 1, 1]),
        ("hard", [0.0, 0.25, 0.9, 1.0], [0, 1, 1, 0]),
        ("straight_through", [0.0, 0.25, 0.9, 1.0], [1, 1, 1, 1]),
    ],
)
def test_clamping(mode, values, gradient):
    pred = torch.tensor([-2.0, 0.25, 0.9, 3.0], requires_grad=True)
    result = prepare(pred, mode)
    assert result.tolist() == pytest.approx(values)
    result.sum().backward()
    assert pred.grad.tolist() == gradient
