import dataclasses

import pytest
import torch

from freqgs_plugin.apps.filters import BRIGHTER, DARK_BLUE, FILTERS, apply_filter
from freqgs_plugin.functional.harmonics import level_colours
from freqgs_plugin.types import Gaussians


def scene(signed=True, levels=5, per=6, degree=1):
    g = torch.Generator().manual_seed(3)
    n, k = levels * per, (degree + 1) ** 2 - 1
    rand = lambda *shape: torch.rand(*shape, generator=g)  # noqa: E731
    level = torch.arange(n) % levels + 1
    return Gaussians(
        rand(n, 3), rand(n, 4) + 0.1, rand(n, 3) * 0.1 + 0.01, rand(n) * 0.8 + 0.1, rand(n, 3), 0.1 * rand(n, k, 3),
        level, signed, decay=rand(n),
    )  # fmt: skip


def colours(g):
    directions = torch.nn.functional.normalize(torch.arange(len(g) * 3.0).reshape(-1, 3).sin(), dim=-1)
    return level_colours(g.features_dc, g.features_rest, directions, g.level, g.signed_residuals)


@pytest.mark.parametrize("signed", [True, False])
def test_xray_is_dark_blue_below_and_brighter_above(signed):
    g = scene(signed)
    out, low = FILTERS["xray"](g), g.level <= 2
    torch.testing.assert_close(colours(out)[low], torch.tensor(DARK_BLUE).expand(int(low.sum()), 3))
    torch.testing.assert_close(colours(out)[~low], colours(g)[~low] + BRIGHTER)
    for name in ("means", "quats", "scales", "opacities", "level", "decay"):
        assert torch.equal(getattr(out, name), getattr(g, name))


@pytest.mark.parametrize("signed", [True, False])
def test_brush_paints_levels_in_turn_and_keeps_the_base(signed):
    g = scene(signed)
    out, base = FILTERS["brush"](g), g.level == 1
    change = colours(out) - colours(g)
    for level, expected in ((1, 0.0), (2, BRIGHTER), (3, -BRIGHTER), (4, BRIGHTER), (5, -BRIGHTER)):
        torch.testing.assert_close(change[g.level == level], torch.full_like(change[g.level == level], expected))
    assert torch.equal(out.means[base], g.means[base])
    shift = ((out.means - g.means) / g.scales.amax(-1, keepdim=True))[~base]
    assert (shift != 0).all() and 0.3 < float(shift.std()) < 0.7
    assert torch.equal(out.means, FILTERS["brush"](g).means), "the same strokes in every picture"


def test_sharp_removes_level_two_and_makes_the_others_opaque():
    g = scene()
    out = FILTERS["sharp"](g)
    assert sorted(set(out.level.tolist())) == [1, 3, 4, 5]
    assert (out.opacities[out.level > 2] == 1).all()
    assert torch.equal(out.opacities[out.level == 1], g.opacities[g.level == 1])
    kept = g.select(g.level != 2)
    change = colours(out) - colours(kept)
    finest = kept.level == 5
    torch.testing.assert_close(change[finest], torch.full_like(change[finest], -BRIGHTER))
    torch.testing.assert_close(change[~finest], torch.zeros_like(change[~finest]))


@pytest.mark.parametrize("name", sorted(FILTERS))
def test_two_levels_and_empty_scenes_are_filtered(name):
    two = apply_filter(scene(levels=2), name)
    assert torch.isfinite(colours(two)).all()
    nothing = scene().select(torch.arange(0))
    assert len(apply_filter(nothing, name)) == 0


def test_scenes_that_lose_every_gaussian_are_empty():
    g = scene(levels=2)
    assert len(FILTERS["sharp"](dataclasses.replace(g, level=torch.full_like(g.level, 2)))) == 0


def test_bad_filters_are_named():
    with pytest.raises(ValueError, match="filter is 'blur'; choose xray, brush, sharp"):
        apply_filter(scene(), "blur")
    with pytest.raises(ValueError, match="one level"):
        apply_filter(scene(levels=1), "xray")
