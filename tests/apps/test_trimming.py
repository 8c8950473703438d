from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from freqgs_plugin.apps.harmonic_fit import fit_harmonics
from freqgs_plugin.apps.trimming import Draft, faintest, highest, most, never_drawn, without_empty_levels
from freqgs_plugin.functional.harmonics import evaluate
from freqgs_plugin.types import Camera, Gaussians


def some(n=6, degree=3, seed=0, **more):
    g = torch.Generator().manual_seed(seed)
    scene = Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.1,
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g),
        level=torch.ones(n, dtype=torch.int32),
    )
    return replace(scene, **more)


def camera_at(*centre):
    pose = torch.eye(4)
    pose[:3, 3] = -torch.tensor(centre)
    return Camera(pose, torch.tensor([[50.0, 0, 20], [0, 50.0, 20], [0, 0, 1]]), 40, 40)


def test_what_is_never_drawn():
    scene = some(decay=torch.tensor([1.0, 0.0, -1.0, 2.0, 1.0, torch.nan]))
    scene.opacities[3] = 0.5 / 255
    scene.means[4, 1] = torch.inf
    assert never_drawn(scene).tolist() == [False, True, True, True, True, True]
    assert not never_drawn(some()).any()


def test_the_last_of_the_base_stays():
    weight, level = torch.tensor([3.0, 1.0, 5.0]), torch.tensor([1, 1, 2])
    assert faintest(weight, level, 1).tolist() == [False, True, False]
    assert faintest(weight, level, 3).tolist() == [False, True, True]


@given(st.integers(0, 500), st.integers(0, 500))
def test_the_most_that_fits(largest, limit):
    assert most(largest, lambda count: count <= limit) == min(largest, limit)


def test_the_highest_number_that_fits():
    found = highest(1e-6, 1e6, lambda x: x <= 7.0, tries=40)
    assert found == pytest.approx(7.0, rel=1e-6)
    assert highest(1.0, 2.0, lambda x: False) is None


def test_levels_close_up():
    level, old = without_empty_levels(torch.tensor([4, 1, 4, 3], dtype=torch.int32))
    assert level.tolist() == [3, 1, 3, 2] and old == [1, 3, 4] and level.dtype == torch.int32


def test_a_draft_remembers_its_rows():
    draft = Draft.of(some()).keep(torch.tensor([0, 1, 1, 0, 1, 0]).bool()).keep(torch.tensor([True, False, True]))
    assert draft.rows.tolist() == [1, 4] and torch.equal(draft.gaussians.means, some().means[[1, 4]])


# -- harmonics ----------------------------------------------------------------------------------------------------


def seen(scene, camera):
    return evaluate(scene.features_dc, scene.features_rest, scene.means - camera.centre)


def test_from_one_direction_a_constant_is_enough():
    scene, camera = some(), camera_at(0.5, -1.0, -6.0)
    fits = fit_harmonics(scene, [camera], [torch.full((6,), 100.0)])
    flat = fits.apply(scene, torch.zeros(6, dtype=torch.int64))
    assert flat.features_rest.shape == (6, 0, 3)
    # the ridge keeps a hundredth
    cut_off = replace(flat, features_dc=scene.features_dc)
    fitted, plain = ((seen(g, camera) - seen(scene, camera)).abs().max() for g in (flat, cut_off))
    assert fitted < 0.05 * plain


def test_what_is_missed_is_what_pictures_miss():
    scene = some(20)
    cameras = [camera_at(3 * x, y, -5.0) for x in (-1.0, 0.0, 1.0) for y in (-2.0, 1.0)]
    weights = [torch.rand(20, generator=torch.Generator().manual_seed(i)) * 50 for i in range(6)]
    fits = fit_harmonics(scene, cameras, weights)
    for degree in range(3):
        lower = fits.apply(scene, torch.full((20,), degree))
        missed = sum(
            w * (seen(lower, c) - seen(scene, c)).square().sum(1) for c, w in zip(cameras, weights, strict=True)
        )
        torch.testing.assert_close(fits.errors[degree], missed, rtol=1e-3, atol=1e-3)
    assert (fits.errors[3] == 0).all() and (fits.errors[0] >= fits.errors[2] - 1e-3).all()


def test_prices_order_degrees():
    scene = some(20)
    scene.features_rest[:5] = 0
    fits = fit_harmonics(scene, [camera_at(0.0, 0.0, -5.0), camera_at(2.0, 0.0, -5.0)], [torch.ones(20)] * 2)
    low, high = fits.prices()
    assert (fits.degrees_at(low)[:5] == 0).all()
    assert (fits.degrees_at(high) == 0).all()
    chosen = [fits.degrees_at(price) for price in torch.logspace(-8, 3, 12).tolist()]
    assert all((after <= before).all() for before, after in pairwise(chosen))


def test_residuals_count_four_times_and_the_unseen_nothing():
    scene = some(4, level=torch.tensor([1, 2, 1, 2], dtype=torch.int32))
    views = [camera_at(0.0, 0.0, -5.0), camera_at(2.0, 0.0, -5.0)]
    weights = [torch.tensor([1.0, 1.0, 0.0, 0.0])] * 2
    signed = fit_harmonics(scene, views, weights).errors
    plain = fit_harmonics(replace(scene, signed_residuals=False), views, weights).errors
    torch.testing.assert_close(signed, plain * torch.tensor([1.0, 4.0, 1.0, 1.0]))
    assert (plain[:, 2:] == 0).all()


def test_of_none():
    assert fit_harmonics(some(0), [camera_at(0.0, 0.0, 0.0)], [torch.zeros(0)]).errors.shape == (4, 0)
