import pytest
import torch

from freqgs_plugin.studio.targets import TargetCache
from freqgs_plugin.training.objective import PyramidTargets


class Source:
    def __init__(self, size=(32, 48), mask=False):
        self.calls = 0
        generator = torch.Generator().manual_seed(0)
        self.image = torch.rand(*size, 3, generator=generator)
        self.mask = (torch.rand(*size, 1, generator=generator) > 0.5).float() if mask else None

    def __call__(self):
        self.calls += 1
        return self.image, self.mask


def test_kept_by_key():
    source, cache = Source(), TargetCache(100)
    first = cache.get((0, 3), source, 3, dft=True)
    assert cache.get((0, 3), source, 3, dft=True) is first and source.calls == 1
    assert cache.get((1, 3), source, 3, dft=True) is not first and source.calls == 2


def test_without_a_key_nothing_is_kept():
    source, cache = Source(), TargetCache(100)
    for _ in range(2):
        cache.get(None, source, 2, dft=True)
    assert source.calls == 2


def test_clear():
    source, cache = Source(), TargetCache(100)
    cache.get(0, source, 2, dft=True)
    cache.clear()
    cache.get(0, source, 2, dft=True)
    assert source.calls == 2


def test_memory_has_a_bound():
    source = Source((256, 256))
    size = TargetCache(100).get(0, source, 3, dft=True).megabytes()
    assert size == pytest.approx(sum(t.numel() * 4 for t in tensors(source)) / 2**20)
    cache = TargetCache(int(2.5 * size))
    for key in (0, 1, 2):
        cache.get(key, source, 3, dft=True)
    source.calls = 0
    for key in (0, 1, 2):
        cache.get(key, source, 3, dft=True)
    assert source.calls == 1


def tensors(source):
    targets = PyramidTargets.from_image(source.image, 3)
    return [targets.magnitudes, *targets.reduced]


@pytest.mark.parametrize("mask", [False, True])
@pytest.mark.parametrize("dft", [False, True])
def test_targets_are_the_objectives(mask, dft):
    source = Source(mask=mask)
    target = TargetCache(1).get(0, source, 3, dft=dft)
    expected = PyramidTargets.from_image(source.image, 3, source.mask, dft=dft)
    assert torch.equal(target.image, source.image) and target.mask is source.mask
    assert all(map(torch.equal, target.pyramid.reduced, expected.reduced))
    assert (target.pyramid.magnitudes is None) == (not dft)
    if dft:
        assert torch.equal(target.pyramid.magnitudes, expected.magnitudes)
