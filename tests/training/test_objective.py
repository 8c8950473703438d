"""Eq. 13 against a float64 computation with OpenCV, numpy and pytorch_msssim."""

import cv2
import numpy as np
import pytest
import torch
from pytorch_msssim import ssim as reference_ssim

from freqgs_plugin.functional.pyramid import low_pass
from freqgs_plugin.training import objective
from freqgs_plugin.training.objective import PyramidTargets, default_level_weights, pyramid_objective


def noise(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scene(m, size=(64, 48)):
    return [noise(*size, 3, seed=k + 1).requires_grad_() for k in range(m)], noise(*size, 3)


def low_passed(image, times):
    sizes = []
    for _ in range(times):
        sizes.append(image.shape[1::-1])
        image = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, 3).mean((1, 3))
    for size in reversed(sizes):
        image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return image


def expected_terms(prefixes, image):
    prefixes, image = [p.detach().numpy() for p in prefixes], image.numpy()
    m, terms, dft = len(prefixes), {}, 0.0
    for k, prefix in enumerate(prefixes, start=1):
        a, b = prefix, image
        for _ in range(m - k):
            a, b = cv2.pyrDown(a), cv2.pyrDown(b)
        planes = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (a, b)]
        distance = 0.8 * np.abs(a - b).mean() + 0.2 * (1 - reference_ssim(*planes, data_range=1.0).item())
        terms[f"image_{k}"] = (1.0 if k == m else 0.1) * distance
        if k < m:
            spectra = [np.abs(np.fft.fft2(x, axes=(0, 1))) for x in (low_passed(image, m - k), prefix)]
            dft += np.abs(spectra[0] - spectra[1]).mean()
    return terms | ({"dft": 1e-3 * dft} if m > 1 else {})


@pytest.mark.parametrize("m", [1, 2, 3])
def test_terms_are_those_of_the_paper(m):
    prefixes, image = scene(m)
    terms = pyramid_objective(prefixes, image)
    expected = expected_terms(prefixes, image)
    assert terms.keys() == expected.keys()
    for name, value in expected.items():
        assert terms[name].item() == pytest.approx(value, rel=1e-5), name  # pytorch_msssim's window is float32


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (15, 17), (33, 20)])
def test_every_size_has_finite_terms_and_gradients(size):
    prefixes, image = scene(4, size)
    sum(pyramid_objective(prefixes, image).values()).backward()
    assert all(torch.isfinite(p.grad).all() and p.grad.abs().sum() > 0 for p in prefixes)


def test_gradients():
    prefixes, image = scene(3, (13, 14))

    def total(*renders):
        return sum(pyramid_objective(list(renders), image, dft_weight=0.1).values())

    assert torch.autograd.gradcheck(total, tuple(prefixes), fast_mode=True)


@pytest.mark.parametrize("use_mask", [False, True])
def test_kept_targets_change_nothing(use_mask):
    prefixes, image = scene(3, (21, 34))
    mask = (noise(21, 34, 1, seed=9) > 0.3).double() if use_mask else None
    kept = PyramidTargets.from_image(image, 3, mask)
    assert pyramid_objective(prefixes, image, mask=mask) == pyramid_objective(prefixes, image, mask=mask, targets=kept)


def test_masked_pixels_do_not_count():
    prefixes, image = scene(2)
    mask = torch.ones(64, 48, 1, dtype=torch.float64)
    mask[20:40, 10:30] = 0
    before = pyramid_objective(prefixes, image, mask=mask)
    changed = [torch.where(mask == 0, 7.0, p.detach()).requires_grad_() for p in prefixes]
    after = pyramid_objective(changed, torch.where(mask == 0, -3.0, image), mask=mask)
    assert before == after
    sum(after.values()).backward()
    assert all((p.grad * (1 - mask) == 0).all() and (p.grad * mask != 0).any() for p in changed)


@pytest.mark.parametrize(
    "options, names",
    [
        ({}, ["image_1", "image_2", "image_3", "dft"]),
        ({"dft": False}, ["image_1", "image_2", "image_3"]),
        ({"dft_weight": 0.0}, ["image_1", "image_2", "image_3"]),
        ({"lower_image_terms": False}, ["image_3", "dft"]),
        ({"level_weights": [0.0, 0.5, 1.0]}, ["image_2", "image_3", "dft"]),
        ({"image_weight": 0.0}, ["dft"]),
        ({"image_weight": 0.0, "dft": False}, []),
    ],
)
def test_terms_of_weight_zero_are_absent(options, names):
    assert list(pyramid_objective(*scene(3), **options)) == names


def test_no_spectrum_is_made_without_the_frequency_term(monkeypatch):
    monkeypatch.setattr(objective, "magnitude", lambda *_: pytest.fail("computed"))
    monkeypatch.setattr(objective, "low_pass", lambda *_: pytest.fail("computed"))
    pyramid_objective(*scene(3), dft=False)
    pyramid_objective(*scene(1))


def test_weights_scale_their_terms():
    prefixes, image = scene(3)
    plain = pyramid_objective(prefixes, image)
    weighted = pyramid_objective(prefixes, image, level_weights=[0.3, 0.1, 2.0], image_weight=5.0, dft_weight=2e-3)
    for name, factor in {"image_1": 15, "image_2": 5, "image_3": 10, "dft": 2}.items():
        assert weighted[name].item() == pytest.approx(factor * plain[name].item(), rel=1e-12)
    ortho = pyramid_objective(prefixes, image, dft_norm="ortho")["dft"]
    assert ortho.item() == pytest.approx(plain["dft"].item() / np.sqrt(64 * 48), rel=1e-12)


def test_transforms_of_a_fast_size_are_those_of_images_with_zeros_around():
    prefixes, image = scene(3, (17, 19))
    targets = PyramidTargets.from_image(image, 3, dft_size="fast")
    assert targets.dft_size == (18, 20) and targets.magnitudes is not None
    low = [low_pass(image.permute(2, 0, 1)[None], n)[0] for n in (2, 1)]
    expected = sum(
        np.abs(np.abs(np.fft.fft2(a, (18, 20))) - np.abs(np.fft.fft2(b, (18, 20)))).mean()
        for a, b in zip(low, (p.detach().permute(2, 0, 1) for p in prefixes), strict=False)
    )
    dft = pyramid_objective(prefixes, image, targets=targets, dft_weight=0.5)["dft"]
    assert dft.item() == pytest.approx(0.5 * expected, rel=1e-10)


def test_the_finest_prefix_has_no_frequency_term():
    prefixes, image = scene(2)
    gradient = torch.autograd.grad(pyramid_objective(prefixes, image)["dft"], prefixes, allow_unused=True)
    assert gradient[0] is not None and (gradient[1] is None or (gradient[1] == 0).all())


@pytest.mark.parametrize("mode, moved", [("none", True), ("hard", False), ("straight_through", True)])
def test_clamping_outside_of_the_range(mode, moved):
    _, image = scene(1)
    prefix = torch.full_like(image, 1.5, requires_grad=True)
    terms = pyramid_objective([prefix], image, clamp_mode=mode)
    clamped = pyramid_objective([prefix.detach().clamp(0, 1)], image)
    assert (terms["image_1"].item() == clamped["image_1"].item()) == (mode != "none")
    sum(terms.values()).backward()
    assert (prefix.grad.abs().sum() > 0).item() == moved


def test_a_perfect_base_is_the_low_passed_image():
    _, image = scene(1)
    targets = PyramidTargets.from_image(image, 2)
    low = torch.from_numpy(low_passed(image.numpy(), 1))
    assert pyramid_objective([low, image], image, targets=targets)["dft"].item() < 1e-9
    assert pyramid_objective([image, image], image, targets=targets)["dft"].item() > 1e-4


def test_default_level_weights():
    assert default_level_weights(1) == [1.0] and default_level_weights(3) == [0.1, 0.1, 1.0]


def test_mismatches_are_named():
    prefixes, image = scene(3)
    with pytest.raises(ValueError, match="3 level weights, got 2"):
        pyramid_objective(prefixes, image, level_weights=[0.1, 1.0])
    with pytest.raises(ValueError, match="for 2 levels, but 3 are rendered"):
        pyramid_objective(prefixes, image, targets=PyramidTargets.from_image(image, 2))
    with pytest.raises(ValueError, match="`dft=False`"):
        pyramid_objective(prefixes, image, targets=PyramidTargets.from_image(image, 3, dft=False))
