import dataclasses

import pytest
import torch
from scenes import camera, splats

from freqgs_plugin.apps.geometry import GeometryIndex
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Gaussians


def scene(n=300, seed=0, dtype=torch.float64):
    s = splats(n, seed=seed, dtype=dtype)
    colours = (s.features, torch.zeros(n, 0, 3, dtype=dtype))
    return Gaussians(s.means, s.quats, s.scales, s.opacities, *colours, torch.arange(n) % 3 + 1)


def one(place, scales=(0.5, 0.5, 0.1), opacity=0.9):
    row = lambda *x: torch.tensor([x], dtype=torch.float64)  # noqa: E731
    colours = (torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 0, 3, dtype=torch.float64))
    return Gaussians(row(*place), row(1, 0, 0, 0), row(*scales), row(opacity)[0], *colours, torch.tensor([1]))


def joined(*parts):
    fields = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "level")
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in fields})


@pytest.mark.parametrize("level", [1, 2, 3])
def test_nearest_is_the_nearest_of_the_prefix(level):
    g = scene()
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    distance, row = GeometryIndex(g, level).nearest(points)
    every = torch.cdist(points, g.means)
    every[:, g.level > level] = torch.inf
    expected, rows = every.min(1)
    torch.testing.assert_close(distance, expected)
    assert torch.equal(row, rows) and (g.level[row] <= level).all()


def test_a_ray_hits_what_is_in_front_at_its_depth():
    view = camera()
    centre = torch.linalg.solve(view.viewmat[:3, :3], -view.viewmat[:3, 3])
    near, far = (one((centre + torch.tensor([0.0, 0.0, z])).tolist()) for z in (3.0, 5.0))
    index = GeometryIndex(joined(far, near))
    hit = index.pick(view, (view.width / 2, view.height / 2))
    assert hit is not None and hit.row == 1 and hit.depth == pytest.approx(3.0)
    torch.testing.assert_close(hit.point, centre + torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64))
    # too thin to stop the ray: what is behind it does
    thin = GeometryIndex(joined(far, dataclasses.replace(near, opacities=torch.tensor([0.2], dtype=torch.float64))))
    hit = thin.pick(view, (view.width / 2, view.height / 2))
    assert hit is not None and hit.row == 0 and hit.depth == pytest.approx(5.0)
    assert GeometryIndex(far).pick(view, (-400.0, 10.0)) is None


def test_a_ray_hits_a_flat_disc_where_it_crosses_its_plane():
    """A disc in the plane z = 4 of the world, seen at a slant."""
    index, view = (
        GeometryIndex(one((0.0, 0.0, 4.0), scales=(2.0, 2.0, 1e-7), opacity=1.0)),
        camera(angles=(0.1, -0.1, 0.3)),
    )
    for x, y in ((18.5, 14.5), (12.5, 10.5), (25.5, 19.5)):
        hit = index.pick(view, (x, y))
        assert hit is not None and float(hit.point[2]) == pytest.approx(4.0, abs=1e-9)
        seen = view.viewmat[:3, :3] @ hit.point + view.viewmat[:3, 3]
        assert float(seen[2]) == pytest.approx(hit.depth, abs=1e-9)
        pixel = view.K @ seen / seen[2]
        assert pixel[:2].tolist() == pytest.approx([x, y], abs=1e-6)


def test_a_picked_depth_is_that_of_the_picture():
    """Straight ahead at a disc that faces the camera: the picture's depth is its centre's, which the ray meets."""
    view = camera()
    g = one((-view.viewmat[:3, 3] + torch.tensor([0.0, 0.0, 4.0])).tolist(), scales=(2.0, 2.0, 0.05), opacity=1.0)
    depth = render(g, view, rasterizer=get_rasterizer("torch", "cpu"), antialiased=False).depth[14, 18, 0]
    hit = GeometryIndex(g).pick(view, (18.5, 14.5))
    assert hit is not None and hit.depth == pytest.approx(float(depth), rel=1e-6)


def test_what_lies_behind_the_camera_is_not_hit():
    view = camera()
    assert GeometryIndex(one((0.0, 0.0, -4.0), scales=(9.0, 9.0, 0.1))).pick(view, (18.0, 14.0)) is None


def test_degenerate_shapes_do_not_break_a_pick():
    g = joined(one((0.0, 0.0, 4.0), scales=(0.0, 0.0, 0.0)), one((0.0, 0.0, 5.0), scales=(1e6, 1e6, 1e-8)))
    zero = dataclasses.replace(g, quats=torch.zeros(2, 4, dtype=torch.float64))
    hit = GeometryIndex(zero).pick(camera(), (18.0, 14.0))
    assert hit is not None and hit.row == 1


def test_bad_input_is_named():
    g = scene(12)
    with pytest.raises(ValueError, match="level is 0"):
        GeometryIndex(g, 0)
    broken = dataclasses.replace(g, means=g.means.index_fill(0, torch.tensor([0]), torch.nan))
    with pytest.raises(ValueError, match="1 centres are not finite"):
        GeometryIndex(broken)
    with pytest.raises(ValueError, match="viewmat has no inverse"):
        GeometryIndex(g).pick(dataclasses.replace(camera(), viewmat=torch.zeros(4, 4, dtype=torch.float64)), (1.0, 1.0))
    with pytest.raises(ValueError, match="points hold NaN"):
        GeometryIndex(g).nearest(torch.full((1, 3), torch.nan, dtype=torch.float64))
