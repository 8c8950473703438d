import dataclasses
import math

import pytest
import torch
from scenes import camera, splats

from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.functional.attenuation import TAU
from freqgs_plugin.functional.projection import project
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Camera, Gaussians


def levelled(n=400, levels=4, seed=0, dtype=torch.float64):
    s = splats(n, seed=seed, dtype=dtype)
    level = torch.arange(n) % levels + 1
    return Gaussians(s.means, s.quats, s.scales, s.opacities, s.features, torch.zeros(n, 0, 3, dtype=dtype), level)


@pytest.mark.parametrize("radius", [0.0, 0.2])
def test_weights_are_gaussians_of_the_distance_to_the_disc(radius):
    g, view = levelled(), camera()
    at = Foveation((0.3, 0.6), sigma=0.15, radius=radius, threshold=0.0)
    centres = project(g.means, g.quats, g.scales, view, 0.3).means2d
    distance = (centres - torch.tensor([0.3 * view.width, 0.6 * view.height])).norm(dim=-1) / view.width
    sigma = 0.15 * 2.0 ** (4 - g.level)
    outside = (distance - radius).clamp_min(0)
    expected = torch.where(g.level > 1, torch.exp(-0.5 * (outside / sigma) ** 2), 1.0)
    assert (expected[outside == 0] == 1).all() and (outside == 0).any() == (radius > 0)
    torch.testing.assert_close(at(g, view), expected, rtol=1e-6, atol=1e-9)


def test_what_is_fainter_than_the_threshold_has_weight_zero_but_for_the_base():
    g, view = levelled(), camera()
    free, cut = (Foveation((0.5, 0.5), 0.1, 0.0, t)(g, view) for t in (0.0, 0.05))
    keep = (g.opacities * free > 0.05) | (g.level == 1)
    assert torch.equal(cut, torch.where(keep, free, 0.0)) and not keep.all()
    assert (cut[g.level == 1] == 1).all()


def test_default_threshold_changes_no_picture():
    """What is left out would not have been drawn: rasterizers skip it by the same number."""
    g, view = levelled(), camera()
    draw = lambda at: render(g, view, at, rasterizer=get_rasterizer("torch", "cpu"), antialiased=False)  # noqa: E731
    free, cut = (draw(Foveation((0.5, 0.5), 0.08, 0.0, t)) for t in (0.0, TAU))
    assert cut.info["drawn"] < free.info["drawn"]
    torch.testing.assert_close(cut.features, free.features, rtol=0, atol=1e-12)


def test_a_wide_fovea_is_the_whole_picture_and_the_gaze_may_lie_outside():
    g, view = levelled(), camera()
    assert Foveation((0.5, 0.5), 1e6)(g, view).min() > 0.999
    outside = Foveation((-3.0, 9.0), 0.05)(g, view)
    assert (outside[g.level == g.level.max()] == 0).all() and (outside[g.level == 1] == 1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extremes_stay_finite(dtype):
    g = levelled(8, dtype=dtype)
    means = torch.tensor([[0, 0, 0], [0, 0, -5], [1e6, 0, 1e-3], [0, 0, 1e6], [1e30, 0, 1], [0, 0, 0.02]], dtype=dtype)
    g = dataclasses.replace(g, means=torch.cat([means, g.means[6:]]))
    for sigma in (1e-12, 0.1, 1e12):
        weight = Foveation((0.5, 0.5), sigma, 0.0)(g, camera(dtype=dtype))
        assert torch.isfinite(weight).all() and (weight >= 0).all() and (weight <= 1).all()
    assert len(Foveation((0.5, 0.5))(g.select(torch.arange(0)), camera(dtype=dtype))) == 0


def test_resolution_does_not_matter():
    g, view = levelled(), camera()
    K = view.K.clone()
    K[:2] *= 4
    large = Camera(view.viewmat, K, 4 * view.width, 4 * view.height)
    at = Foveation((0.4, 0.5), 0.1)
    torch.testing.assert_close(at(g, large), at(g, view), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"gaze": (math.nan, 0.5)}, "gaze is"),
        ({"gaze": (0.5, 0.5), "sigma": 0.0}, "sigma is 0.0"),
        ({"gaze": (0.5, 0.5), "sigma": math.inf}, "sigma is inf"),
        ({"gaze": (0.5, 0.5), "radius": -1.0}, "radius is -1.0"),
        ({"gaze": (0.5, 0.5), "threshold": -0.1}, "threshold is -0.1"),
        ({"gaze": (0.5, 0.5), "threshold": 1.1}, "threshold is 1.1"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Foveation(**arguments)
