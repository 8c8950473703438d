from dataclasses import replace

import pytest
import scenes
import torch

from freqgs_plugin.functional.attenuation import DistanceDecay, LevelCut
from freqgs_plugin.rendering.numba_backend import NumbaRasterizer
from freqgs_plugin.rendering.render import render, render_prefixes, rendered_weight
from freqgs_plugin.rendering.torch_backend import TorchRasterizer
from freqgs_plugin.types import Gaussians

CAMERA = scenes.camera(dtype=torch.float32)


def gaussians(n=40):
    s = scenes.splats(n, dtype=torch.float32)
    generator = torch.Generator().manual_seed(3)
    sh = torch.randn(n, 4, 3, generator=generator) * 0.3
    level = torch.randint(1, 4, (n,), generator=generator, dtype=torch.int32)
    return Gaussians(s.means, s.quats, s.scales, s.opacities, sh[:, 0], sh[:, 1:], level)


@pytest.fixture(params=[NumbaRasterizer, TorchRasterizer])
def rasterizer(request):
    return request.param()


def test_a_prefix_is_the_picture_of_its_levels(rasterizer, assert_close):
    g = gaussians()
    for k in (1, 2, 3):
        cut = render(g, CAMERA, LevelCut(k), rasterizer=rasterizer)
        alone = render(g.select(g.level <= k), CAMERA, rasterizer=rasterizer)
        assert cut.info["drawn"] == int((g.level <= k).sum())
        assert torch.equal(cut.features, alone.features)


def test_training_and_viewing_show_the_same_prefixes(rasterizer, assert_close):
    g = gaussians()
    background = torch.tensor([0.2, 0.4, 0.6])
    prefixes = render_prefixes(g, CAMERA, 3, rasterizer=rasterizer, background=background)
    for k, prefix in enumerate(prefixes, start=1):
        cut = render(g, CAMERA, LevelCut(k), rasterizer=rasterizer, background=background)
        assert_close(prefix.features, cut.features, loosen=0.1)


def test_level_zero_is_the_background(rasterizer):
    background = torch.tensor([0.2, 0.4, 0.6])
    picture = render(gaussians(), CAMERA, LevelCut(0), rasterizer=rasterizer, background=background)
    assert torch.equal(picture.features, background.expand_as(picture.features))


@pytest.mark.parametrize("statistics", ["own", "full"])
def test_both_ways_to_render_prefixes_collect_the_same_statistics(statistics, assert_close):
    """torch renders prefix by prefix, numba all in one pass."""
    collected = []
    for rasterizer in (TorchRasterizer(), NumbaRasterizer()):
        g = gaussians()
        g.means.requires_grad_()
        prefixes = render_prefixes(g, CAMERA, 3, rasterizer=rasterizer, statistics=statistics)
        weights = (1.0, 0.5, 2.0)
        sum(w * p.features.square().sum() for w, p in zip(weights, prefixes, strict=True)).backward()
        means2d = prefixes[-1].info["means2d"]
        collected.append((means2d.grad, means2d.absgrad, g.means.grad))
    for a, b in zip(*collected, strict=True):
        assert ((a - b).norm() / b.norm()) < 1e-4


def test_weights_add_up_to_what_is_covered(rasterizer, assert_close):
    g = gaussians()
    weight = rendered_weight(g, CAMERA, 1, rasterizer=rasterizer)
    covered = render(g, CAMERA, rasterizer=rasterizer).alpha.sum()
    assert_close(weight.sum(), covered, loosen=10)
    assert (weight >= 0).all()


def test_weights_in_float64(assert_close):
    g = gaussians()
    fields = {
        name: value.double() for name, value in vars(g).items() if torch.is_tensor(value) and value.is_floating_point()
    }
    camera = replace(CAMERA, viewmat=CAMERA.viewmat.double(), K=CAMERA.K.double())
    reference = TorchRasterizer()
    weight = rendered_weight(replace(g, **fields), camera, 1, rasterizer=reference)
    assert weight.dtype == torch.float64
    assert_close(rendered_weight(g, CAMERA, 1, rasterizer=reference), weight, loosen=10)


def test_weights_count_every_prefix(rasterizer, assert_close):
    g = gaussians()
    expected = torch.zeros(len(g))
    for k in (1, 2, 3):
        rows = g.level <= k
        expected[rows] += rendered_weight(g.select(rows), CAMERA, 1, rasterizer=rasterizer)
    assert_close(rendered_weight(g, CAMERA, 3, rasterizer=rasterizer), expected, loosen=10)


def test_what_is_covered_or_outside_weighs_nothing(rasterizer):
    front, back, outside = (0.1, -0.05, 2.0), (0.1, -0.05, 4.0), (50.0, 0.0, 3.0)
    n = 3
    g = Gaussians(
        means=torch.tensor([front, back, outside]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.tensor([[5.0] * 3, [0.01] * 3, [0.1] * 3]),
        opacities=torch.tensor([1.0, 1.0, 1.0]),
        features_dc=torch.zeros(n, 3),
        features_rest=torch.zeros(n, 0, 3),
        level=torch.ones(n, dtype=torch.int32),
    )
    weight = rendered_weight(g, scenes.camera(width=9, height=9, dtype=torch.float32), 1, rasterizer=rasterizer)
    assert weight[0] > 50 and weight[1] < 0.1 and weight[2] == 0


def fading():
    """Decays from 0.05 to 20: about half of these Gaussians are hidden."""
    g = gaussians()
    return replace(g, decay=torch.logspace(-1.3, 1.3, len(g)), level=torch.ones_like(g.level))


def test_training_and_viewing_show_the_same_fading(rasterizer, assert_close):
    g, decay = fading(), DistanceDecay(1.5, "frustum_max", soft=False)
    background = torch.tensor([0.2, 0.4, 0.6])
    (trained,) = render_prefixes(g, CAMERA, 1, decay, rasterizer=rasterizer, background=background)
    seen = render(g, CAMERA, decay, rasterizer=rasterizer, background=background)
    assert 0 < trained.info["drawn"] == seen.info["drawn"] < len(g)
    assert_close(trained.features, seen.features, loosen=0.1)
    everything = render(g, CAMERA, rasterizer=rasterizer, background=background)
    assert float((everything.features - seen.features).abs().max()) > 0.1


def test_rows_of_weight_0_stay_and_count_as_not_seen(rasterizer):
    g, decay = fading(), DistanceDecay(1.5, "frustum_max")
    g.means.requires_grad_()
    shown = decay(g, CAMERA) > 0
    (with_decay,) = render_prefixes(g, CAMERA, 1, decay, rasterizer=rasterizer)
    (without,) = render_prefixes(g, CAMERA, 1, rasterizer=rasterizer)
    assert with_decay.info["radii"].shape == without.info["radii"].shape == (1, len(g))
    assert bool((with_decay.info["radii"][0, ~shown] == 0).all())
    assert torch.equal(with_decay.info["radii"][0, shown], without.info["radii"][0, shown])
    assert bool((without.info["radii"][0, ~shown] > 0).any())
    with_decay.features.square().sum().backward()
    means2d = with_decay.info["means2d"]
    assert bool((means2d.grad[0, ~shown] == 0).all()) and bool((means2d.grad[0, shown] != 0).any())
    assert bool((g.means.grad[~shown] == 0).all())


def test_nothing_to_draw_is_the_background(rasterizer):
    g = replace(fading(), decay=torch.full((40,), -1.0))
    g.means.requires_grad_()
    background = torch.tensor([0.2, 0.4, 0.6])
    decay = DistanceDecay(2.0, "frustum_max")
    (trained,) = render_prefixes(g, CAMERA, 1, decay, rasterizer=rasterizer, background=background)
    trained.features.sum().backward()
    seen = render(g, CAMERA, decay, rasterizer=rasterizer, background=background)
    assert trained.info["drawn"] == seen.info["drawn"] == 0
    assert torch.equal(trained.features, background.expand_as(trained.features))
    assert torch.equal(seen.features, trained.features)
    assert bool((g.means.grad == 0).all()) and bool((trained.info["means2d"].grad == 0).all())


def test_rendered_weights_fade_with_distance(rasterizer):
    g, decay = fading(), DistanceDecay(1.5, "frustum_max")
    weight = rendered_weight(g, CAMERA, 1, decay, rasterizer=rasterizer)
    shown = decay(g, CAMERA) > 0
    assert bool((weight[~shown] == 0).all())
    expected = rendered_weight(g.select(shown), CAMERA, 1, decay, rasterizer=rasterizer)
    torch.testing.assert_close(weight[shown], expected, rtol=1e-5, atol=1e-5)


class Counting:
    """A rasterizer that counts the prefixes that it composites."""

    name, absgrad = "counting", True

    def __init__(self, inner):
        self.inner, self.composited = inner, 0

    def __call__(self, splats, camera, **options):
        self.composited += 1
        return self.inner(splats, camera, **options)


class CountingPrefixes(Counting):
    def prefixes(self, splats, level, num_levels, camera, **options):
        self.composited += num_levels
        return self.inner.prefixes(splats, level, num_levels, camera, **options)


@pytest.mark.parametrize("levels, num_levels, composited", [((1, 3), 3, 2), ((1, 4), 5, 3), ((3,), 5, 3), ((2,), 3, 3)])
@pytest.mark.parametrize("inner", [NumbaRasterizer, TorchRasterizer])
def test_prefixes_of_empty_levels_cost_nothing_and_change_nothing(inner, levels, num_levels, composited, assert_close):
    g = gaussians()
    level = torch.tensor(levels, dtype=torch.int32)[torch.arange(len(g)) % len(levels)]
    found = []
    for statistics in ("full", "own"):
        leaf = g.means.clone().requires_grad_()
        counting = (CountingPrefixes if inner is NumbaRasterizer else Counting)(inner())
        scene = replace(g, means=leaf, level=level)
        pictures = render_prefixes(scene, CAMERA, num_levels, rasterizer=counting, statistics=statistics)
        assert counting.composited == (composited if statistics == "full" else num_levels)
        for k, picture in enumerate(pictures, start=1):
            cut = render(scene, CAMERA, LevelCut(k), rasterizer=inner())
            assert_close(picture.features.detach(), cut.features.detach(), loosen=0.1)
        torch.stack([k * p.features.square().sum() for k, p in enumerate(pictures, start=1)]).sum().backward()
        assert pictures[-1].info["radii"].shape == (1, len(g))
        found.append(leaf.grad)
    assert_close(found[0], found[1], loosen=100)


def test_levels_outside_of_the_models_are_refused_beside_empty_ones():
    g = replace(gaussians(), level=torch.full((40,), 4, dtype=torch.int32))
    with pytest.raises(ValueError, match=r"outside of 1\.\.3"):
        render_prefixes(g, CAMERA, 3, rasterizer=NumbaRasterizer())
