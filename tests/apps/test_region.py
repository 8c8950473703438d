import dataclasses

import pytest
import torch
from scenes import camera, splats

from freqgs_plugin.apps.region import Ball
from freqgs_plugin.types import Gaussians


def scene(n=300, dtype=torch.float64):
    s = splats(n, dtype=dtype)
    colours = (s.features, torch.zeros(n, 0, 3, dtype=dtype))
    return Gaussians(s.means, s.quats, s.scales, s.opacities, *colours, torch.arange(n) % 3 + 1)


@pytest.mark.parametrize("outside_level", [0, 1, 2, 3])
def test_whole_in_the_ball_and_the_lower_levels_elsewhere(outside_level):
    g = scene()
    centre = g.means.mean(0)
    inside = (g.means - centre).norm(dim=-1) <= 1.0
    assert 0 < inside.sum() < len(g)
    weight = Ball(tuple(centre.tolist()), 1.0, outside_level)(g, camera())
    assert torch.equal(weight, (inside | (g.level <= outside_level)).double())


@pytest.mark.parametrize("radius, expected", [(1e-30, 0), (1e30, 300)])
def test_the_least_and_the_largest_balls(radius, expected):
    weight = Ball((9.0, 9.0, 9.0), radius, outside_level=0)(scene(dtype=torch.float32), camera())
    assert weight.dtype == torch.float32 and int(weight.sum()) == expected


def test_the_camera_does_not_matter_and_nothing_learns():
    g = scene()
    g = dataclasses.replace(g, means=g.means.requires_grad_())
    ball = Ball((0.0, 0.0, 4.0), 1.0)
    assert torch.equal(ball(g, camera()), ball(g, camera(9, 7, angles=(0.3, 3.0, 0.1))))
    assert not ball(g, camera()).requires_grad
    assert ball(g.select(torch.zeros(0, dtype=torch.long)), camera()).shape == (0,)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("inf"), float("nan")])
def test_bad_radius(radius):
    with pytest.raises(ValueError, match=rf"radius is {radius}; it must be a finite number > 0"):
        Ball((0.0, 0.0, 0.0), radius)


def test_bad_centre():
    with pytest.raises(ValueError, match="it must be three finite world coordinates"):
        Ball((0.0, float("nan"), 0.0), 1.0)
