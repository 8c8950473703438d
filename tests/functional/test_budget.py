import itertools
import math
from dataclasses import replace

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import wrightomega

from freqgs_plugin.functional import budget
from freqgs_plugin.functional.attenuation import TAU, DistanceDecay, log_attenuated, normalised_distance
from freqgs_plugin.functional.budget import TIE, DecayBudget, LevelBudget, decay_scale, in_view, log_cutoff
from freqgs_plugin.functional.projection import project
from freqgs_plugin.types import Camera, Gaussians

CAMERA = Camera(torch.eye(4), torch.tensor([[90.0, 0, 60], [0, 90.0, 45], [0, 0, 1]]), 120, 90)
KEYS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "level", "decay")
DTYPES = [torch.float32, torch.float64]


def gaussians(n=2000, seed=0, dtype=torch.float32, levels=1, spread=3.0):
    """About half of them in view of CAMERA; some faint, some with a dead decay."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=g) * spread + torch.tensor([0.0, 0, 5])
    return Gaussians(
        means=means.to(dtype),
        quats=torch.randn(n, 4, generator=g).to(dtype),
        scales=torch.exp(torch.randn(n, 3, generator=g) - 4).to(dtype),
        opacities=torch.sigmoid(3 * torch.randn(n, generator=g)).to(dtype),
        features_dc=torch.zeros(n, 3, dtype=dtype),
        features_rest=torch.zeros(n, 0, 3, dtype=dtype),
        level=torch.randint(1, levels + 1, (n,), generator=g),
        decay=(4 + 2 * torch.randn(n, generator=g)).to(dtype),
    )


def bisected(opacity, distance, decay):
    """ln s*, by halving the range of scales with the attenuation's own function."""
    low, high = -40.0, 10.0
    value = [torch.tensor([x], dtype=torch.float64) for x in (opacity, distance, decay)]
    for _ in range(200):
        middle = (low + high) / 2
        drawn = float(log_attenuated(*value, math.exp(middle))) > math.log(TAU) + middle
        low, high = (middle, high) if drawn else (low, middle)
    return low


# -- cut-offs ---------------------------------------------------------------------------------------------------------


@given(st.floats(1e-3, 1.0), st.floats(1e-6, 1e4), st.floats(-1.0, 1e4))
@settings(max_examples=150)
def test_cutoffs_are_the_bisected_ones(opacity, distance, decay):
    found = log_cutoff(*(torch.tensor([x], dtype=torch.float64) for x in (opacity, distance, decay)))
    assert float(found) == pytest.approx(bisected(opacity, distance, decay), abs=1e-11, rel=0)


def test_cutoffs_are_lamberts_function():
    z = torch.linspace(-60, 700, 200_001, dtype=torch.float64)
    # σ of 0 makes a = d'^2 / ε
    opacity = torch.full_like(z, 0.5)
    b = math.log(0.5 / TAU)
    distance = (((z - 2 * b) / 2).exp() * math.sqrt(1e-8 / 2)).clamp_min(0)
    found = log_cutoff(opacity, distance, torch.zeros_like(z))
    a = distance.square() / 1e-8
    expected = b - torch.from_numpy(wrightomega(((2 * a).log() + 2 * b).numpy())) / 2
    # a rounding error of z, which is up to 700, is the floor
    assert ((found - expected).abs() <= 1e-12 + 2e-16 * z.abs()).all()


@pytest.mark.parametrize("opacity", [1.0, 0.3, 1e-3, 1e-30])
def test_without_distance_the_cutoff_is_the_opacity_over_tau(opacity):
    one = torch.tensor([opacity], dtype=torch.float64)
    for distance, decay in ((0.0, 5.0), (0.0, 0.0), (0.0, -1.0), (1.0, 1e30)):
        found = log_cutoff(one, one * 0 + distance, one * 0 + decay)
        assert float(found) == pytest.approx(math.log(opacity / TAU), abs=1e-14)


def test_extremes_stay_finite_and_ordered():
    decay = torch.tensor([0.0, -3.0, 1e-20, 1e-4, 1.0, 1e6, 1e30])
    distance = torch.full_like(decay, 1e15)
    found = log_cutoff(torch.ones_like(decay), distance, decay)
    assert torch.isfinite(found).all()
    assert (found.diff() >= 0).all()
    assert log_cutoff(torch.zeros(1), torch.ones(1), torch.ones(1)).item() == -math.inf


@given(st.floats(0.01, 1), st.floats(0.01, 3), st.floats(0.1, 20), st.floats(0.5, 2))
def test_scaling_distance_and_decay_together_changes_nothing(opacity, distance, decay, factor):
    def cutoff(d, s):
        return float(log_cutoff(*(torch.tensor([x], dtype=torch.float64) for x in (opacity, d, s))))

    assert cutoff(distance, decay) == pytest.approx(cutoff(distance * factor, decay * factor), abs=1e-5)


# -- what is in view --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", scenes.awkward())
def test_everything_that_a_rasterizer_draws_is_in_view(name, dtype):
    splats, camera = scenes.awkward()[name]
    camera = scenes.cast(camera, dtype)
    scene = Gaussians(
        splats.means.to(dtype),
        splats.quats.to(dtype),
        splats.scales.to(dtype),
        splats.opacities.to(dtype),
        torch.zeros(len(splats), 3, dtype=dtype),
        torch.zeros(len(splats), 0, 3, dtype=dtype),
        torch.ones(len(splats), dtype=torch.int64),
    )
    drawn = project(scene.means, scene.quats, scene.scales, camera, blur=0.3).visible
    assert (in_view(scene, camera) | ~drawn).all()


def test_little_else_is_in_view():
    scene = gaussians(5000)
    drawn = project(scene.means, scene.quats, scene.scales, CAMERA, blur=0.3).visible
    assert int(in_view(scene, CAMERA).sum()) < 1.02 * int(drawn.sum())


def test_behind_and_beside_the_camera_is_out_of_view():
    means = torch.tensor([[0.0, 0, 5], [0, 0, -5], [0, 0, 0], [50, 0, 5], [0, 0, 0.0100001]])
    n = len(means)
    scene = replace(gaussians(n), means=means, scales=torch.full((n, 3), 1e-3))
    assert in_view(scene, CAMERA).tolist() == [True, False, False, False, True]


def test_means_that_are_not_finite_are_out_of_view():
    scene = gaussians(4)
    means = scene.means.clone()
    means[:] = torch.tensor([0.0, 0, 5])
    means[0, 0], means[1, 2], means[2, 2] = math.nan, math.inf, -math.inf
    for dtype in DTYPES:
        cast = replace(scene, means=means.to(dtype), scales=scene.scales.to(dtype))
        assert in_view(cast, CAMERA).tolist() == [False, False, False, True]


def test_compiled_and_torch_agree():
    scene = gaussians(5000)
    double = gaussians(5000, dtype=torch.float64)
    double = replace(double, **{k: getattr(scene, k).double() for k in ("means", "scales", "opacities", "decay")})
    assert torch.equal(in_view(scene, CAMERA), in_view(double, CAMERA))
    distance = normalised_distance(scene, CAMERA, "frustum_max")
    seen = in_view(scene, CAMERA)
    single = budget._exponents_above(scene, distance, seen, 0.3)
    twice = budget._exponents_above(double, distance.double(), seen, 0.3)
    assert len(single[0]) > 1000
    for a, b in zip(single, twice, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-14, atol=1e-14)


# -- scale for a count ------------------------------------------------------------------------------------------------


def drawn_at(scene, scale, **options):
    weight = DistanceDecay(scale, **options)(scene, CAMERA)
    return int(((weight > 0) & in_view(scene, CAMERA)).sum())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("options", [{"reference": "frustum_max"}, {"reference": "scene", "scene_distance": 4.0}])
@pytest.mark.parametrize("seed", range(3))
def test_the_count_is_met_by_what_is_drawn(dtype, options, seed):
    scene = gaussians(4000, seed, dtype)
    full = drawn_at(scene, 1.0, **options)
    for count in (1, 2, 17, full // 3, full // 2, full - 2, full - 1):
        fit = decay_scale(scene, CAMERA, count, **options)
        assert fit.drawn == drawn_at(scene, fit.scale, **options)
        assert count - 1 <= fit.drawn <= count and fit.scale > 1 and not fit.note


def test_the_scale_is_the_order_statistic():
    scene = gaussians(3000, dtype=torch.float64)
    distance = normalised_distance(scene, CAMERA, "frustum_max")
    cutoffs = log_cutoff(scene.opacities, distance, scene.decay)[in_view(scene, CAMERA)]
    ordered = cutoffs.sort(descending=True).values.tolist()
    for count in (1, 3, 100, 700):
        scale = decay_scale(scene, CAMERA, count, "frustum_max").scale
        assert math.log(scale) == pytest.approx((ordered[count - 1] + ordered[count]) / 2, abs=1e-12)


def test_the_scale_falls_as_the_count_grows():
    scene = gaussians(1500)
    scales = [decay_scale(scene, CAMERA, n, "frustum_max").scale for n in range(1, 1000)]
    assert all(a >= b for a, b in itertools.pairwise(scales)) and scales[0] > 2 and scales[-1] == 1


def test_never_below_full_detail():
    scene = gaussians()
    full = drawn_at(scene, 1.0, reference="frustum_max")
    for count in (full, full + 1, 10**12):
        assert decay_scale(scene, CAMERA, count, "frustum_max") == budget.Fit(1.0, full)


@pytest.mark.parametrize("least", [0.5, 2.0, 20.0])
def test_a_slider_may_ask_for_less_than_the_budget_allows(least):
    scene = gaussians()
    options = {"reference": "frustum_max"}
    at_least = drawn_at(scene, least, **options)
    assert decay_scale(scene, CAMERA, at_least, "frustum_max", least=least) == budget.Fit(least, at_least)
    fewer = decay_scale(scene, CAMERA, at_least - 5, "frustum_max", least=least)
    assert fewer.scale > least and fewer.drawn == at_least - 5
    weight = DecayBudget(10**6, "frustum_max", least=least)(scene, CAMERA)
    assert int((weight > 0).sum()) == at_least
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="scale is"):
            decay_scale(scene, CAMERA, 5, "frustum_max", least=bad)


def test_many_gaussians_take_the_same_path_to_the_same_scale():
    few = gaussians(500, dtype=torch.float64)
    many = Gaussians(**{key: getattr(few, key).repeat_interleave(40, 0) for key in KEYS})
    # every cut-off 40 times: a budget of 40 n ends where one of n does
    for n in (1, 50, 200):
        a, b = (decay_scale(s, CAMERA, c, "frustum_max") for s, c in ((few, n), (many, 40 * n)))
        assert a.scale == pytest.approx(b.scale, abs=1e-12) and b.drawn == 40 * a.drawn


def test_ties_are_dropped_together():
    scene = gaussians(300, dtype=torch.float64)
    one = scene.select(in_view(scene, CAMERA)).select(torch.arange(50))
    twice = Gaussians(**{k: torch.cat([getattr(one, k)] * 2) for k in KEYS})
    full = decay_scale(twice, CAMERA, 10**6, "frustum_max").drawn
    assert full == 2 * decay_scale(one, CAMERA, 10**6, "frustum_max").drawn
    for count in range(3, full - 1):
        fit = decay_scale(twice, CAMERA, count, "frustum_max")
        assert fit.drawn == count - count % 2
        assert fit.drawn == drawn_at(twice, fit.scale, reference="frustum_max")


def test_a_tie_of_all_is_drawn_whole_and_says_so():
    scene = gaussians(1)
    scene = replace(scene, means=torch.tensor([[0.0, 0, 5]]), opacities=torch.tensor([0.9]), decay=torch.tensor([4.0]))
    same = Gaussians(**{k: getattr(scene, k).repeat_interleave(9, 0) for k in KEYS})
    fit = decay_scale(same, CAMERA, 4, "frustum_max")
    assert fit.drawn == 9 == drawn_at(same, fit.scale, reference="frustum_max")
    assert fit.note == "9 Gaussians vanish at the same scale; fewer would be none."


def test_cutoffs_nearer_than_float32_tells_never_exceed_the_count():
    n = 300
    base = gaussians(n)
    means = torch.tensor([[0.0, 0, 5]]).repeat(n, 1)
    means[:, 2] += 1e-6 * torch.arange(n)
    scene = replace(base, means=means, opacities=torch.full((n,), 0.8), decay=torch.full((n,), 3.0))
    for count in range(1, n):
        fit = decay_scale(scene, CAMERA, count, "scene", 5.0)
        actual = drawn_at(scene, fit.scale, reference="scene", scene_distance=5.0)
        assert actual <= count or fit.note
        assert abs(actual - fit.drawn) <= 1


def test_nothing_in_view():
    scene = gaussians(20)
    behind = replace(scene, means=scene.means * 0 - 3.0)
    assert decay_scale(behind, CAMERA, 5, "frustum_max") == budget.Fit(1.0, 0)
    empty = scene.select(torch.zeros(20, dtype=torch.bool))
    assert decay_scale(empty, CAMERA, 5, "frustum_max") == budget.Fit(1.0, 0)
    assert DecayBudget(5, "frustum_max")(empty, CAMERA).shape == (0,)


@pytest.mark.parametrize("count", [0, -3, 2.5, math.nan, math.inf])
@pytest.mark.parametrize("make", [DecayBudget, LevelBudget])
def test_counts_that_are_none_are_refused(count, make):
    with pytest.raises(ValueError, match=r"the budget is .* Gaussians; it must be a whole number of at least 1"):
        make(count)


def test_a_scene_without_decay_is_refused():
    with pytest.raises(ValueError, match="have no decay"):
        decay_scale(replace(gaussians(), decay=None), CAMERA, 10, "frustum_max")
    with pytest.raises(ValueError, match="scene_distance is None"):
        DecayBudget(10)


# -- as attenuations --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("soft", [True, False])
def test_decay_budget_draws_the_count_and_nothing_out_of_view(soft):
    scene = gaussians(4000)
    weight = DecayBudget(300, "frustum_max", soft=soft)(scene, CAMERA)
    assert int((weight > 0).sum()) == 300
    assert (weight[~in_view(scene, CAMERA)] == 0).all()
    scale = decay_scale(scene, CAMERA, 300, "frustum_max").scale
    expected = DistanceDecay(scale, "frustum_max", soft=soft)(scene, CAMERA)
    assert torch.equal(weight, expected * in_view(scene, CAMERA))


@pytest.mark.parametrize("largest", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("soft", [True, False])
def test_beyond_the_largest_scale_those_that_show_most_stay(largest, soft):
    scene = gaussians(4000)
    at_largest = DistanceDecay(largest, "frustum_max", soft=soft)(scene, CAMERA) * in_view(scene, CAMERA)
    fits = int((at_largest > 0).sum())
    kept = DecayBudget(fits, "frustum_max", soft=soft, largest=largest)
    assert kept.scale(scene, CAMERA) <= largest and torch.equal(kept(scene, CAMERA) > 0, at_largest > 0)
    fewer = DecayBudget(fits // 3, "frustum_max", soft=soft, largest=largest)
    weight = fewer(scene, CAMERA)
    assert fewer.scale(scene, CAMERA) == largest and int((weight > 0).sum()) == fits // 3
    assert (weight <= at_largest).all()
    area = scene.scales.sort(-1).values[:, 1:].prod(-1) / scene.means[:, 2].square()
    shows = scene.opacities * at_largest * area
    assert shows[weight > 0].min() > shows[(weight == 0) & (at_largest > 0)].max()
    if not soft:
        assert torch.equal(weight[weight > 0], at_largest[weight > 0])


def test_a_slider_beyond_the_largest_scale_counts():
    budgeted = DecayBudget(10**6, "frustum_max", least=7.0, largest=3.0)
    assert budgeted.scale(gaussians(), CAMERA) == 7.0


@pytest.mark.parametrize("largest", [0.0, -1.0, math.nan])
def test_a_largest_scale_that_is_none(largest):
    with pytest.raises(ValueError, match="the largest scale is"):
        DecayBudget(5, "frustum_max", largest=largest)


def test_a_tie_does_not_break_an_attenuations_budget():
    scene = gaussians(300)
    one = scene.select(in_view(scene, CAMERA)).select(torch.arange(1))
    g = torch.Generator().manual_seed(0)
    same = Gaussians(**{key: getattr(one, key).repeat_interleave(9, 0) for key in KEYS})
    same = replace(same, opacities=torch.full((9,), 0.9), decay=torch.full((9,), 4.0))
    same = replace(same, scales=same.scales * (1 + torch.rand(9, 1, generator=g)))
    assert int((DecayBudget(4, "frustum_max")(same, CAMERA) > 0).sum()) == 4


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("spread", [0.0, 1e-7, 1e-4])
def test_equal_ones_fill_a_budget_as_well(soft, spread):
    """Splats of one size and opacity on a plane that faces the camera; pairs of one place."""
    plane = gaussians(100)
    means = torch.stack([torch.linspace(-0.5, 0.5, 100), torch.zeros(100), torch.full((100,), 3.0)], -1)
    same = {
        "scales": torch.full((100, 3), 0.05),
        "opacities": 0.5 + spread * torch.rand(100),
        "decay": torch.full((100,), 4.0),
    }
    plane = replace(plane, means=means, **same)
    twins = replace(
        plane, means=means[::2].repeat_interleave(2, 0), opacities=plane.opacities[::2].repeat_interleave(2)
    )
    for scene in (plane, twins):
        for count in (1, 10, 50, 99):
            for at in (LevelBudget(count, soft), DecayBudget(count, "frustum_max", soft=soft, largest=5.0)):
                weight = at(scene, CAMERA)
                assert 0.75 * count <= int((weight > 0).sum()) <= count
                assert weight.sum() > 0.4 * count * weight.max() and weight.max() > 0.1


def in_view_by_level(scene):
    return torch.bincount(scene.level[in_view(scene, CAMERA)])[1:].tolist()


def test_levels_are_whole_as_long_as_they_fit():
    scene = gaussians(3000, levels=4)
    first, second, third, fourth = in_view_by_level(scene)
    for count, level, fraction in (
        (first, 1, 0),
        (first + second, 2, 0),
        (first + second + third // 2, 2, third // 2 / third),
        (first + second + third + fourth, 4, 0),
        (10**9, 4, 0),
    ):
        fit = LevelBudget(count).fit(scene, CAMERA)
        assert (fit.level, fit.fraction) == (level, pytest.approx(fraction))
        assert fit.drawn == min(count, first + second + third + fourth)
        weight = LevelBudget(count)(scene, CAMERA)
        assert int((weight > 0).sum()) == fit.drawn
        assert (weight[in_view(scene, CAMERA) & (scene.level <= level)] == 1).all()
        assert (weight[scene.level > level + 1] == 0).all()


def test_where_not_even_the_base_fits_it_is_drawn_in_part():
    scene = gaussians(3000, levels=2)
    fit = LevelBudget(50).fit(scene, CAMERA)
    assert fit.level == 0 and fit.drawn == 50 and fit.fraction == pytest.approx(50 / in_view_by_level(scene)[0])
    weight = LevelBudget(50)(scene, CAMERA)
    assert int((weight > 0).sum()) == 50 and set(scene.level[weight > 0].tolist()) == {1}


def test_of_the_next_level_those_that_show_most_stay():
    scene = gaussians(500, spread=0.3)
    same = replace(scene, scales=torch.full((500, 3), 0.01), means=scene.means * 0 + torch.tensor([0.0, 0, 5]))
    weight = LevelBudget(40, soft=False)(same, CAMERA)
    assert set(weight.tolist()) == {0.0, 1.0}
    kept, left = same.opacities[weight == 1], same.opacities[weight == 0]
    assert len(kept) == 40 and kept.min() > left.max()
    # at equal opacity the larger one, and the nearer one
    opaque = replace(same, opacities=torch.ones(500), scales=torch.full((500, 3), 0.01) * torch.arange(1, 501)[:, None])
    assert LevelBudget(3, soft=False)(opaque, CAMERA)[-3:].tolist() == [1, 1, 1]
    depths = torch.linspace(9, 3, 500)[:, None] * torch.tensor([[0.0, 0, 1]])
    near = replace(same, opacities=torch.ones(500), means=depths)
    assert LevelBudget(3, soft=False)(near, CAMERA)[-3:].tolist() == [1, 1, 1]


def test_more_budget_never_takes_any_away():
    scene = gaussians(600, levels=3)
    for soft in (True, False):
        before = torch.zeros(600)
        for count in range(1, 330, 7):
            weight = LevelBudget(count, soft)(scene, CAMERA)
            assert (weight >= before).all() and weight.max() <= 1
            before = weight


def test_the_last_ones_fade_in():
    scene = gaussians(4000)
    weight = LevelBudget(500)(scene, CAMERA)
    shown = weight[weight > 0]
    assert 0 < shown.min() < 0.05 and (shown == 1).sum() > 100
    # as the camera moves a little, no weight jumps
    moved = Camera(torch.eye(4), CAMERA.K, 120, 90)
    moved.viewmat[2, 3] += 1e-4
    stays = in_view(scene, CAMERA) & in_view(scene, moved)
    change = (LevelBudget(500)(scene, moved) - weight).abs()[stays]
    assert change.max() < 0.02


def test_an_empty_scene():
    empty = gaussians(5).select(torch.zeros(5, dtype=torch.bool))
    assert LevelBudget(3).fit(empty, CAMERA) == budget.LevelFit(0, 0.0, 0)
    assert LevelBudget(3)(empty, CAMERA).shape == (0,)


def test_no_gradient_is_asked_for():
    scene = gaussians(200)
    leaf = scene.decay.clone().requires_grad_()
    assert decay_scale(replace(scene, decay=leaf), CAMERA, 20, "frustum_max").drawn == 20


def test_ties_are_narrower_than_a_visible_step():
    assert TIE < 1e-5
