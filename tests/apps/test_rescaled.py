"""Foveation with fewer pixels: the same picture where one looks, no seam, and about the same elsewhere."""

import pytest
import torch

from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.rescaled import SEAM, _enlarged, render_rescaled, smaller, suitable
from freqgs_plugin.functional.attenuation import LevelCut, Product
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Camera, Gaussians

WIDTH, HEIGHT = 321, 240


@pytest.fixture(scope="module")
def gaussians():
    """Small ones everywhere in view, so that none reaches far beyond the fovea's rectangle."""
    g, n = torch.Generator().manual_seed(0), 600
    means = (torch.rand(n, 3, generator=g) - 0.5) * torch.tensor([3.4, 2.6, 0.4]) + torch.tensor([0, 0, 3.0])
    return Gaussians(
        means, torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.05 + 0.05,
        torch.rand(n, generator=g) * 0.9, torch.randn(n, 3, generator=g), torch.zeros(n, 0, 3), torch.arange(n) % 3 + 1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def camera():
    K = torch.tensor([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
    return Camera(torch.eye(4), K, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def look():
    return {"rasterizer": get_rasterizer("numba", "cpu"), "background": torch.full((3,), 0.2), "antialiased": True}


def eccentricity(gaze):
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    return torch.hypot(x - gaze[0] * WIDTH, y - gaze[1] * HEIGHT) / WIDTH


@pytest.mark.parametrize("gaze", [(0.5, 0.5), (0.0, 0.3), (0.97, 0.99)])
@pytest.mark.parametrize("times", [2, 4])
def test_where_one_looks_it_is_the_foveated_picture(gaussians, camera, look, gaze, times):
    foveation = Foveation(gaze, sigma=0.05, radius=0.12)
    plain = render(gaussians, camera, foveation, **look)
    found = render_rescaled(gaussians, camera, foveation, times=times, **look)
    inside, outside = eccentricity(gaze) <= 0.12, eccentricity(gaze) > 0.12 + SEAM
    for name in ("features", "alpha", "depth"):
        a, b = getattr(found, name), getattr(plain, name)
        assert a.shape == b.shape
        torch.testing.assert_close(a[inside], b[inside], atol=1e-5, rtol=1e-5)
    difference = (found.features - plain.features).abs()
    assert difference[outside].max() > 1e-3, "fewer pixels"
    assert difference[outside].mean() < 0.03
    assert found.info["drawn"] == plain.info["drawn"] and found.info["width"] == WIDTH


def test_the_seam_has_no_edge(gaussians, camera, look):
    """The error grows along the seam by no more from pixel to pixel than it does beyond it."""
    gaze = (0.5, 0.5)
    foveation = Foveation(gaze, sigma=0.05, radius=0.12)
    plain = render(gaussians, camera, foveation, **look).features
    error = (render_rescaled(gaussians, camera, foveation, times=4, **look).features - plain).mean(-1)
    seam = (eccentricity(gaze) > 0.11) & (eccentricity(gaze) < 0.13 + SEAM)
    beyond = eccentricity(gaze) > 0.13 + SEAM
    steps = (error[:, 1:] - error[:, :-1]).abs()
    assert steps[seam[:, 1:]].max() <= 1.1 * steps[beyond[:, 1:]].max()


def test_other_attenuations_combine(gaussians, camera, look):
    foveation, cut = Foveation((0.5, 0.5), 0.05, 0.12), LevelCut(2)
    expected = render(gaussians, camera, Product((foveation, cut)), **look)
    found = render_rescaled(gaussians, camera, foveation, cut, times=2, **look)
    inside = eccentricity((0.5, 0.5)) <= 0.12
    torch.testing.assert_close(found.features[inside], expected.features[inside], atol=1e-5, rtol=1e-5)
    assert found.info["drawn"] == expected.info["drawn"]


def test_a_wide_fovea_or_no_rescaling_is_the_plain_picture(gaussians, camera, look):
    for foveation, times in ((Foveation((0.5, 0.5), 0.5, 0.1), 4), (Foveation((0.5, 0.5), 0.05, 0.1), 1)):
        plain = render(gaussians, camera, foveation, **look)
        found = render_rescaled(gaussians, camera, foveation, times=times, **look)
        assert torch.equal(found.features, plain.features)
    far = render_rescaled(gaussians, camera, Foveation((9.0, 9.0), 0.05), times=2, **look)
    assert far.features.shape == (HEIGHT, WIDTH, 3) and torch.isfinite(far.features).all()
    with pytest.raises(ValueError, match="0 times smaller"):
        render_rescaled(gaussians, camera, Foveation((0.5, 0.5)), times=0, **look)


def test_enlarging_keeps_pixels_where_they_are(camera):
    """Linear in x and y: away from the border, bilinear enlargement gives it back exactly; as torch does."""
    for times in (2, 3, 4):
        small = smaller(camera, times)
        y, x = torch.meshgrid(torch.arange(small.height) + 0.5, torch.arange(small.width) + 0.5, indexing="ij")
        ramp = torch.stack([x * times, y * times], -1)
        large = _enlarged(ramp, times, camera)
        y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
        inner = slice(times, -times)
        torch.testing.assert_close(large[inner, inner], torch.stack([x, y], -1)[inner, inner], atol=1e-3, rtol=0)
        planes = ramp.permute(2, 0, 1)[None]
        other = torch.nn.functional.interpolate(planes, scale_factor=times, mode="bilinear")[0].permute(1, 2, 0)
        torch.testing.assert_close(large, other[:HEIGHT, :WIDTH], atol=1e-3, rtol=0)


@pytest.mark.parametrize(("width", "times"), [(640, 1), (1919, 1), (1920, 2), (3840, 4), (8000, 4)])
def test_what_suits_a_size(width, times):
    assert suitable(Camera(torch.eye(4), torch.eye(3), width, 100)) == times
