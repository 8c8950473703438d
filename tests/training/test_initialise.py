import pytest
import torch

from freqgs_plugin.functional.harmonics import C0
from freqgs_plugin.training.initialise import initial_parameters, neighbour_distance, random_points


def generator():
    return torch.Generator().manual_seed(0)


def test_parameters_of_splatfacto():
    points = torch.rand(20, 3, generator=generator())
    colours = torch.rand(20, 3, generator=generator())
    p = initial_parameters(points, colours, 3, generator())
    assert {k: tuple(v.shape) for k, v in p.items()} == {
        "means": (20, 3), "scales": (20, 3), "quats": (20, 4), "features_dc": (20, 3), "features_rest": (20, 15, 3),
        "opacities": (20, 1),
    }  # fmt: skip
    torch.testing.assert_close(p["features_dc"] * C0 + 0.5, colours)
    torch.testing.assert_close(torch.sigmoid(p["opacities"]), torch.full((20, 1), 0.1))
    torch.testing.assert_close(p["quats"].norm(dim=-1), torch.ones(20))


def test_distance_is_the_mean_of_three_nearest():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [100, 0, 0]])
    assert neighbour_distance(points)[0] == pytest.approx(2.0)


@pytest.mark.parametrize("n", [2, 5, 50])
def test_duplicate_points_have_finite_scales(n):
    points = torch.cat([torch.zeros(n, 3), torch.rand(10, 3, generator=generator())])
    distance = neighbour_distance(points)
    assert (distance > 0).all() and torch.isfinite(distance.log()).all()


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_few_points(n):
    assert (neighbour_distance(torch.rand(n, 3, generator=generator())) > 0).all()


def test_all_points_at_one_place():
    assert (neighbour_distance(torch.ones(7, 3)) == 1).all()


def test_bad_points_are_named():
    points = torch.zeros(4, 3)
    points[1] = float("nan")
    with pytest.raises(ValueError, match="1 of 4 seed points are not finite"):
        initial_parameters(points, torch.zeros(4, 3), 0, generator())
    with pytest.raises(ValueError, match="no seed points"):
        initial_parameters(torch.zeros(0, 3), torch.zeros(0, 3), 0, generator())


def test_random_points_fill_the_cube():
    points, colours = random_points(1000, 10.0, generator())
    assert points.abs().max() <= 5 and points.abs().max() > 4.5
    assert colours.min() >= 0 and colours.max() <= 1
