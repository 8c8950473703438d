"""Laws that every picture obeys, for both CPU backends, and inputs at the ends of float32's range."""

import pytest
import scenes
import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.torch_backend import TorchRasterizer

BACKENDS = ("torch", "numba")


@pytest.fixture(params=BACKENDS)
def rasterizer(request):
    """A CPU backend, which then renders float32."""
    return get_rasterizer(request.param, "cpu")


def rendered(rasterizer, splats, camera, dtype=torch.float32, antialiased=True):
    """Rendering and leaves, after backward of the sum of squared features."""
    leaves = scenes.leaves_of(splats, dtype)
    rendering = rasterizer(leaves, scenes.cast(camera, dtype), antialiased=antialiased)
    if len(splats):
        rendering.features.square().sum().backward()
    return rendering, leaves


@pytest.mark.parametrize("length", [1e-38, 1e-30, 1e-21])
def test_a_quaternion_without_a_direction_is_the_identity(rasterizer, length):
    """Below 1e-20 the gradient, which grows with the inverse length, would leave float32's range."""
    splats, camera = scenes.splats(), scenes.camera()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(len(splats), 4)
    expected, _ = rendered(rasterizer, scenes.replace(splats, quats=upright), camera)
    actual, leaves = rendered(rasterizer, scenes.replace(splats, quats=splats.quats * length), camera)
    assert torch.equal(actual.features, expected.features)
    assert torch.equal(leaves.quats.grad, torch.zeros_like(leaves.quats))


@pytest.mark.parametrize("size", [1e6, 1e12, 1e20, 1e38])
def test_gaussians_wider_than_any_image_cover_it(rasterizer, size, assert_close):
    splats = scenes.replace(scenes.splats(), scales=torch.full((40, 3), size).double())
    actual, leaves = rendered(rasterizer, splats, scenes.camera())
    expected, _ = rendered(TorchRasterizer(), splats, scenes.camera(), torch.float64)
    assert expected.alpha.min() > 0.99
    assert_close(actual.features.detach(), expected.features.detach())
    assert all(torch.isfinite(getattr(leaves, key).grad).all() for key in scenes.LEAVES)
