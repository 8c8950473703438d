import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from freqgs_plugin.functional.attenuation import LevelCut, Product, SingleLevel
from freqgs_plugin.types import Camera, Gaussians

LEVELS = torch.tensor([1, 1, 2, 3, 2, 3, 5])
CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)


def gaussians():
    n = len(LEVELS)
    return Gaussians(torch.zeros(n, 3), torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), torch.zeros(n, 1, 3), LEVELS)


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
