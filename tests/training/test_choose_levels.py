import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from freqgs_plugin.functional.pyramid import laplacian
from freqgs_plugin.training.choose_levels import MOST_LEVELS, choose_levels


def noise(height=256, width=320, seed=0):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def smooth(height=256, width=320):
    x = torch.linspace(0, 1, width).expand(height, width)
    return torch.stack([x, 1 - x, x / 2], -1)


def test_noise_needs_all_and_a_ramp_none():
    assert choose_levels([noise()], 30, 0.1).levels == MOST_LEVELS
    chosen = choose_levels([smooth()], 30, 0.1)
    assert chosen.levels < 3 and not chosen.kept[-1] and "dropped 1/1 size" in chosen.text()
    assert choose_levels([smooth()], 30, 0).levels == MOST_LEVELS
    assert choose_levels([torch.full((256, 256, 3), 0.5)], 30, 0.1).levels == 1


def test_energies_are_those_of_the_bands():
    image = noise(64, 80)
    found = choose_levels([image, image], 30, 0.1)
    bands = laplacian(image.permute(2, 0, 1)[None], 3)[1:]
    assert found.energies == pytest.approx([float(b.square().mean()) for b in bands], rel=1e-5)
    assert found.bound == pytest.approx(1e-4)


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 130), st.integers(1, 130))
def test_the_coarsest_image_keeps_16_px(height, width):
    found = choose_levels([noise(height, width)], 30, 0)
    assert found.levels == 1 or min(height, width) / 2 ** (found.levels - 1) >= 16
    assert f"{width}x{height}" in found.text() or found.levels == MOST_LEVELS


def test_the_smallest_image_decides():
    found = choose_levels([noise(), noise(32, 40), noise(100, 100)], 30, 0)
    assert found.levels == 2 and found.size == (40, 32)


@pytest.mark.parametrize(("psnr", "share"), [(30, -1), (float("nan"), 0.1), (30, float("inf"))])
def test_what_cannot_be(psnr, share):
    with pytest.raises(ValueError, match="finite numbers"):
        choose_levels([noise(16, 16)], psnr, share)
    with pytest.raises(ValueError, match="no images"):
        choose_levels([], 30, 0.1)
