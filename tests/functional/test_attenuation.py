import dataclasses
import math
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from freqgs_plugin.functional.attenuation import (
    EPSILON,
    TAU,
    DistanceDecay,
    LevelCut,
    Product,
    SingleLevel,
    decay_of,
    frustum_distance,
    log_attenuated,
    normalised_distance,
)
from freqgs_plugin.types import Camera, Gaussians

LEVELS = torch.tensor([1, 1, 2, 3, 2, 3, 5])
CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)


def gaussians():
    n = len(LEVELS)
    colours = (torch.zeros(n, 3), torch.zeros(n, 0, 3))
    return Gaussians(torch.zeros(n, 3), torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), *colours, LEVELS)


@pytest.mark.parametrize("k", range(7))
def test_whole_level_is_the_prefix(k):
    assert LevelCut(k)(gaussians(), CAMERA).tolist() == (LEVELS <= k).float().tolist()


def test_fraction_fades_the_next_level_in():
    weight = LevelCut(1.25)(gaussians(), CAMERA)
    assert weight.tolist() == [1, 1, 0.25, 0, 0.25, 0, 0]


@given(st.floats(0, 6), st.floats(0, 6))
def test_monotone_and_within_bounds(a, b):
    low, high = sorted((a, b))
    less, more = (LevelCut(level)(gaussians(), CAMERA) for level in (low, high))
    assert (less >= 0).all() and (more <= 1).all() and (less <= more + 1e-6).all()


@given(st.floats(0.01, 5.9))
def test_continuous(level):
    near = LevelCut(level + 1e-4)(gaussians(), CAMERA)
    assert (near - LevelCut(level)(gaussians(), CAMERA)).abs().max() <= 2e-4


@pytest.mark.parametrize("level", [float("inf"), 1e30])
def test_any_high_level_draws_all(level):
    assert (LevelCut(level)(gaussians(), CAMERA) == 1).all()


@pytest.mark.parametrize("level", [-1.0, float("nan")])
def test_bad_level_is_refused(level):
    with pytest.raises(ValueError, match="level is"):
        LevelCut(level)


def test_product():
    both = Product((LevelCut(2.5), SingleLevel(3)))
    assert both(gaussians(), CAMERA).tolist() == [0, 0, 0, 0.5, 0, 0.5, 0]
    assert (Product(())(gaussians(), CAMERA) == 1).all()


VIEW = Camera(torch.eye(4), torch.tensor([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]), 64, 48)
REFERENCES = ("frustum_max", "frustum_quantile", "scene")


def decaying(distance, decay=5.0, opacity=0.8, dtype=torch.float32):
    """Gaussians on the optical axis of VIEW, at these distances."""
    distance = torch.as_tensor(distance, dtype=dtype)
    n = len(distance)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=dtype)
    return Gaussians(
        means=distance[:, None] * axis,
        quats=torch.ones(n, 4, dtype=dtype),
        scales=torch.ones(n, 3, dtype=dtype),
        opacities=torch.as_tensor(opacity, dtype=dtype).expand(n).clone(),
        features_dc=torch.zeros(n, 3, dtype=dtype),
        features_rest=torch.zeros(n, 0, 3, dtype=dtype),
        level=torch.ones(n, dtype=torch.int32),
        decay=torch.as_tensor(decay, dtype=dtype).expand(n).clone(),
    )


class TestDistanceDecay:
    @pytest.mark.parametrize(("distance", "sigma", "scale"), [(0.5, 5.0, 3.0), (1.0, 3.0, 5.0), (0.3, 0.7, 1.0)])
    def test_closed_form(self, distance, sigma, scale):
        weight = DistanceDecay(scale, "scene", 2.0)(decaying([2 * distance], sigma), VIEW)
        assert float(weight) == pytest.approx(math.exp(-((distance * scale) ** 2) / (2 * sigma**2 + EPSILON)), rel=1e-5)

    @settings(deadline=None)
    @given(st.floats(1, 50), st.floats(1, 50), st.floats(0.01, 20), st.floats(0.0, 1.0), st.booleans())
    def test_falls_with_the_scale_and_is_a_weight(self, a, b, sigma, opacity, soft):
        scene = decaying(torch.linspace(0, 3, 20), sigma, opacity)
        near, far = (DistanceDecay(s, "scene", 1.5, soft)(scene, VIEW) for s in sorted((a, b)))
        assert (far >= 0).all() and (near <= 1).all() and (far <= near).all()

    @settings(deadline=None)
    @given(st.floats(1, 50), st.floats(0.01, 20), st.floats(0.01, 1.0), st.booleans())
    def test_falls_with_distance_and_rises_with_sigma(self, scale, sigma, opacity, soft):
        decay = DistanceDecay(scale, "scene", 1.5, soft)
        weight = decay(decaying(torch.linspace(0, 6, 50), sigma, opacity), VIEW)
        assert (weight.diff() <= 0).all()
        weight = decay(decaying(torch.full((50,), 2.0), torch.linspace(-1, 30, 50), opacity), VIEW)
        assert (weight.diff() >= 0).all()

    @settings(deadline=None)
    @given(st.floats(1, 30), st.floats(0.05, 20))
    def test_the_soft_cut_hides_the_same_and_is_continuous(self, scale, sigma):
        scene = decaying(torch.linspace(0, 4, 4001, dtype=torch.float64), sigma, 0.9, torch.float64)
        hard, soft = (DistanceDecay(scale, "scene", 1.0, s)(scene, VIEW) for s in (False, True))
        assert torch.equal(soft > 0, hard > 0) and (soft <= hard).all()
        clear = hard * 0.9 >= 2 * TAU * scale
        torch.testing.assert_close(soft[clear], hard[clear])
        # along distance, opacity falls by at most what its slope allows: the step of the hard cut is TAU * scale
        slope = (scale / sigma) * 0.9 * 4
        assert (soft * 0.9).diff().abs().max() <= slope * 1e-3 + 1e-9

    def test_the_cut_is_at_tau_times_the_scale(self):
        at = torch.tensor([0.999, 1.001]) * TAU * 3
        assert DistanceDecay(3.0, "scene", 1e9)(decaying([1.0, 1.0], 1e3, at), VIEW).gt(0).tolist() == [False, True]
        drawn = DistanceDecay(3.0, "scene", 1.0).margin(decaying(torch.linspace(0, 4, 99)), VIEW) > 0
        assert torch.equal(drawn, DistanceDecay(3.0, "scene", 1.0)(decaying(torch.linspace(0, 4, 99)), VIEW) > 0)

    def test_at_scale_1_nothing_is_cut_that_is_drawn_anyway(self):
        scene = decaying(torch.linspace(0, 3, 100), 1.0, 0.7)
        weight = DistanceDecay(1.0, "scene", 1.0, soft=False)(scene, VIEW)
        expected = torch.exp(-scene.means[:, 2].square() / 2)
        assert (expected[weight == 0] * 0.7 <= TAU * 1.0001).all()
        torch.testing.assert_close(weight[weight > 0], expected[weight > 0])

    @pytest.mark.parametrize("soft", [False, True])
    @pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
    @pytest.mark.parametrize("sigma", [-2.0, 0.0, 1e-8, 1e-3, 1.0, 6e4])
    def test_extremes_are_finite(self, soft, dtype, sigma):
        """Scales to 1e6, distances 0 to 6e4 of the scene's, opacities 0 and 1: values and gradients."""
        distance = torch.tensor([0.0, 1e-6, 0.5, 1.0, 1e4, 6e4]).repeat(2)
        opacity = torch.tensor([0.0, 1.0]).repeat_interleave(6)
        for scale in (1, 1e3, 1e6, 1e300):
            for reference in REFERENCES:
                scene = decaying(distance, sigma, opacity, dtype)
                scene.decay.requires_grad_()
                scene.opacities.requires_grad_()
                weight = DistanceDecay(scale, reference, 1.0, soft)(scene, VIEW)
                grads = torch.autograd.grad(weight.sum() + 0 * scene.opacities.sum(), (scene.decay, scene.opacities))
                assert weight.dtype == torch.promote_types(dtype, torch.float32)
                assert all(bool(x.isfinite().all()) for x in (weight, *grads))
                assert bool(((weight >= 0) & (weight <= 1)).all())
                if sigma <= 0:
                    away = normalised_distance(scene, VIEW, reference, 1.0) * min(scale, 1e30) > 2e-3
                    assert bool((grads[0] == 0).all()) and bool((weight[away] == 0).all()) and bool(away.any())

    @pytest.mark.parametrize("sigma", [-2.0, 0.0, 1e-8, 1e-3, 1.0, 1e8, 3e38])
    def test_the_logarithm_is_finite(self, sigma):
        distance = torch.tensor([0.0, 1e-6, 0.5, 1.0, 1e4, 1e15]).repeat(2)
        opacity = torch.tensor([0.0, 1.0]).repeat_interleave(6).requires_grad_()
        decay = torch.full((12,), sigma, requires_grad=True)
        for scale in (1, 1e6, 1e300):
            value = log_attenuated(opacity, distance, decay, scale)
            grads = torch.autograd.grad(value.sum(), (opacity, decay))
            assert all(bool(x.isfinite().all()) for x in (value, *grads))

    @pytest.mark.parametrize("soft", [False, True])
    def test_gradients(self, soft):
        scene = decaying(torch.linspace(0.2, 4, 12), 1.0, 1.0, torch.float64)
        sigma = torch.linspace(3, 0.3, 12, dtype=torch.float64, requires_grad=True)
        opacity = torch.linspace(0.05, 0.95, 12, dtype=torch.float64, requires_grad=True)

        def opacities(sigma, opacity):
            changed = dataclasses.replace(scene, decay=sigma, opacities=opacity)
            return opacity * DistanceDecay(2.5, "scene", 1.0, soft)(changed, VIEW)

        hidden = opacities(sigma, opacity) == 0
        assert 0 < int(hidden.sum()) < 12
        torch.autograd.gradcheck(opacities, (sigma, opacity))

    @pytest.mark.parametrize("reference", REFERENCES)
    def test_distance_has_no_gradient(self, reference):
        scene = decaying([1.0, 2.0])
        means = scene.means.clone().requires_grad_()
        viewmat = torch.eye(4, requires_grad=True)
        weight = DistanceDecay(2.0, reference, 1.0)(
            dataclasses.replace(scene, means=means), dataclasses.replace(VIEW, viewmat=viewmat)
        )
        assert not weight.requires_grad

    @pytest.mark.parametrize("soft", [False, True])
    @pytest.mark.parametrize("scale", [1e-6, 1.0, 3.7, 1e3, 1e300])
    def test_compiled_for_viewing_it_is_the_same(self, soft, scale):
        """Without gradients a kernel does it; with one, torch."""
        distance = [0.0, 1e-30, 1e-6, 0.1, 0.5, 0.9, 1.0, 2.0, 7.0, 1e4, 1e15, 1e30]
        decay = [-2.0, 0.0, 1e-8, 1e-3, 0.3, 1.0, 5.0, 6e4, 3e38]
        opacity = [0.0, 1e-38, 0.003, 0.004, 0.0079, 0.1, 0.9, 1.0, 1.5]
        grid = torch.cartesian_prod(*map(torch.tensor, (distance, decay, opacity)))
        scene = decaying(grid[:, 0], grid[:, 1], grid[:, 2])
        attenuation = DistanceDecay(scale, "scene", 1.3, soft)
        compiled = attenuation(scene, VIEW)
        by_torch = attenuation(dataclasses.replace(scene, decay=scene.decay.clone().requires_grad_()), VIEW)
        assert by_torch.requires_grad and not compiled.requires_grad
        torch.testing.assert_close(compiled, by_torch.detach(), rtol=3e-5, atol=1e-6)
        clear = attenuation.margin(scene, VIEW).abs() > 1e-5
        assert torch.equal((compiled > 0)[clear], (by_torch > 0)[clear]) and int(clear.sum()) > 900

    def test_what_is_not_a_number_is_not_drawn(self):
        nan = float("nan")
        scene = decaying([nan, 1.0, 1.0, 1.0], [1.0, nan, 1.0, 1.0], [0.5, 0.5, nan, 0.5])
        weight = DistanceDecay(1.0, "scene", 1.0)(scene, VIEW)
        assert (weight > 0).tolist()[0::2] == [False, False] and weight[3] > 0

    def test_autocast_changes_nothing(self):
        scene = dataclasses.replace(decaying(torch.linspace(0, 3, 50)), means=torch.randn(50, 3))
        turned = dataclasses.replace(VIEW, viewmat=torch.linalg.qr(torch.randn(4, 4))[0])
        turned.viewmat[3] = torch.tensor([0.0, 0, 0, 1])
        expected = DistanceDecay(3.0, "frustum_max")(scene, turned)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(DistanceDecay(3.0, "frustum_max")(scene, turned), expected)

    def test_order_does_not_matter(self):
        scene = decaying(torch.linspace(0.1, 3, 30), torch.linspace(-1, 9, 30))
        order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
        for reference in REFERENCES:
            decay = DistanceDecay(2.0, reference, 1.0)
            assert torch.equal(decay(scene.select(order), VIEW), decay(scene, VIEW)[order])

    def test_selected_rows_keep_their_decay(self):
        scene = decaying([1.0, 2.0, 3.0], torch.tensor([4.0, 5.0, 6.0]))
        assert scene.select(torch.tensor([2, 0])).decay.tolist() == [6.0, 4.0]
        assert scene.select(torch.tensor([False, True, False])).decay.tolist() == [5.0]
        assert gaussians().select(torch.tensor([0])).decay is None

    @pytest.mark.parametrize("scale", [0, -1.0, float("nan"), float("inf")])
    def test_bad_scales_are_refused(self, scale):
        with pytest.raises(ValueError, match=r"scale is .*; it must be a finite number > 0"):
            DistanceDecay(scale, "frustum_max")

    @pytest.mark.parametrize("distance", [None, 0.0, -1.0, float("nan"), float("inf")])
    def test_the_scene_needs_a_distance(self, distance):
        with pytest.raises(ValueError, match="choose frustum_max or frustum_quantile"):
            DistanceDecay(1.0, "scene", distance)

    def test_gaussians_without_decay_are_refused(self):
        with pytest.raises(ValueError, match=r"have no decay.*Train them with clodsplat"):
            DistanceDecay(2.0, "frustum_max")(gaussians(), VIEW)


class TestReferences:
    def test_frustum_max_is_the_farthest_that_the_image_shows(self):
        scene = decaying([1.0, 2.0, 4.0])
        beside = dataclasses.replace(scene, means=torch.cat([scene.means[:2], torch.tensor([[9.0, 0.0, 4.0]])]))
        behind = dataclasses.replace(scene, means=torch.cat([scene.means[:2], torch.tensor([[0.0, 0.0, -4.0]])]))
        assert normalised_distance(scene, VIEW, "frustum_max").tolist() == [0.25, 0.5, 1.0]
        for hidden in (beside, behind):
            assert normalised_distance(hidden, VIEW, "frustum_max").tolist()[:2] == [0.5, 1.0]
            assert frustum_distance(hidden, VIEW) == 2.0

    def test_a_far_gaussian_changes_frustum_max_alone(self):
        near = decaying(torch.linspace(0.1, 1, 300))
        far = decaying(torch.cat([torch.linspace(0.1, 1, 300), torch.tensor([1e4])]))
        ratio = {}
        for reference in REFERENCES:
            before, after = (normalised_distance(s, VIEW, reference, 1.0)[:300] for s in (near, far))
            ratio[reference] = float((after / before).mean())
        assert ratio == {
            "frustum_max": pytest.approx(1e-4), "frustum_quantile": pytest.approx(1, abs=0.01), "scene": 1.0
        }  # fmt: skip

    def test_the_quantile(self):
        assert frustum_distance(decaying(torch.arange(1.0, 201.0)), VIEW, "frustum_quantile") == 198.0
        assert frustum_distance(decaying([3.0]), VIEW, "frustum_quantile") == 3.0

    @pytest.mark.parametrize("reference", ["frustum_max", "frustum_quantile"])
    def test_an_empty_frustum_takes_all_gaussians(self, reference):
        scene = decaying([-1.0, -2.0])
        assert normalised_distance(scene, VIEW, reference).tolist() == [0.5, 1.0]

    @pytest.mark.parametrize("reference", REFERENCES)
    def test_all_at_the_camera(self, reference):
        assert normalised_distance(decaying([0.0, 0.0]), VIEW, reference, 1.0).tolist() == [0.0, 0.0]
        assert DistanceDecay(9.0, reference, 1.0)(decaying([0.0], 0.0, 1.0), VIEW).tolist() == [1.0]

    @pytest.mark.parametrize("reference", REFERENCES)
    def test_no_gaussians(self, reference):
        assert DistanceDecay(2.0, reference, 1.0)(decaying([]), VIEW).shape == (0,)
        assert frustum_distance(decaying([]), VIEW) == 0.0

    def test_an_unknown_one_is_refused(self):
        code = (
            "from freqgs_plugin.functional.attenuation import DistanceDecay\n"
            "try: DistanceDecay(1.0, 'near')\n"
            "except ValueError as error: print(error)"
        )
        # in a process of its own, without the type checks that would come first
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        assert "reference is 'near'; choose frustum_max, frustum_quantile or scene" in said


def test_a_view_matrix_without_an_inverse_is_named():
    with pytest.raises(ValueError, match="viewmat has no inverse"):
        DistanceDecay(1.0, "scene", 2.0)(replace_decay(), Camera(torch.zeros(4, 4), torch.eye(3), 4, 4))


def test_a_decay_that_is_not_everyones_is_named():
    with pytest.raises(ValueError, match=r"decay has the shape \[1\], and opacities \[7\]"):
        decay_of.__wrapped__(SimpleNamespace(decay=torch.ones(1), opacities=torch.ones(7)))


def replace_decay():
    return dataclasses.replace(gaussians(), decay=torch.ones(len(LEVELS)))
