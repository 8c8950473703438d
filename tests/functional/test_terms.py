"""The compiled terms, with one gradient for all, against the same terms one by one."""

from dataclasses import replace

import pytest
import torch

from freqgs_plugin.functional import compiled_terms, terms
from freqgs_plugin.functional.pyramid import reduce
from freqgs_plugin.functional.spectrum import fast_size, magnitude
from freqgs_plugin.functional.terms import Terms, prefix_terms, terms_one_by_one

SIZE = (46, 59)


def noise(*shape, seed, dtype=torch.float64):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def case(m, dtype=torch.float64, size=SIZE, dft=True):
    image = noise(1, 3, *size, seed=0, dtype=dtype)
    dft_size = fast_size(*size)
    lower = torch.cat([noise(1, 3, *size, seed=20 + k, dtype=dtype) for k in range(m)][: m - 1]) if m > 1 else None
    made = Terms(
        reduced=[reduce(image, m - k) for k in range(1, m + 1)],
        image_weights=[0.3] * (m - 1) + [1.0],
        ssim_weight=0.2,
        magnitudes=magnitude(lower, dft_size) if dft and lower is not None else None,
        dft_size=dft_size,
        dft_weight=0.02,
        dft_norm="backward",
    )
    return made, [noise(1, 3, *size, seed=10 + k, dtype=dtype).requires_grad_() for k in range(m)]


def gradients(values, renders, factors=None):
    given = [v for v in values if v is not None]
    factors = [1.0] * len(given) if factors is None else factors
    total = sum(value * factor for value, factor in zip(given, factors, strict=True))
    return torch.autograd.grad(
        total, [r for r in renders if r.requires_grad], allow_unused=True, materialize_grads=True
    )


@pytest.fixture
def compiled_only(monkeypatch):
    def refused(*_):
        raise AssertionError("not compiled")

    monkeypatch.setattr(terms, "terms_one_by_one", refused)


CHANGES = {
    "plain": {},
    "orthonormal": {"dft_norm": "ortho"},
    "SSIM alone": {"ssim_weight": 1.0},
    "no frequency term": {"magnitudes": None},
    "no lower image terms": {"image_weights": [0.0, 0.0, 1.0]},
    "one left out": {"image_weights": [0.2, 0.0, 1.0], "magnitudes": None},
    "frequency term alone": {"image_weights": [0.0, 0.0, 0.0]},
    "frequency term of weight 0": {"dft_weight": 0.0},
}


@pytest.mark.usefixtures("compiled_only")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("change", CHANGES)
def test_equal_to_terms_one_by_one(change, dtype, assert_close):
    made, renders = case(3, dtype)
    made = replace(made, **CHANGES[change])
    values, expected = prefix_terms(made, renders), terms_one_by_one(made, renders)
    for value, other, weight in zip(values, expected, made.weights, strict=True):
        assert (value is None) == (weight == 0)
        if value is not None:
            assert_close(value, other)
    for gradient, other in zip(gradients(values, renders), gradients(expected, renders), strict=True):
        assert_close(gradient, other)


@pytest.mark.usefixtures("compiled_only")
@pytest.mark.parametrize("m", [1, 2, 4])
def test_any_number_of_levels(m, assert_close):
    made, renders = case(m, size=(91, 107))
    values, expected = prefix_terms(made, renders), terms_one_by_one(made, renders)
    for gradient, other in zip(gradients(values, renders), gradients(expected, renders), strict=True):
        assert_close(gradient, other)


@pytest.mark.usefixtures("compiled_only")
@pytest.mark.parametrize("factors", [[2.0] * 4, [1.0, -2.0, 0.5, 3.0], [0.0, 0.0, 1.0, 0.0]])
def test_terms_may_be_weighted_again(factors, assert_close):
    made, renders = case(3)
    values, expected = prefix_terms(made, renders), terms_one_by_one(made, renders)
    pairs = zip(gradients(values, renders, factors), gradients(expected, renders, factors), strict=True)
    for gradient, other in pairs:
        assert_close(gradient, other)


@pytest.mark.usefixtures("compiled_only")
def test_one_term_by_itself_and_constant_renders(assert_close):
    made, renders = case(3)
    renders[1] = renders[1].detach()
    value, expected = prefix_terms(made, renders)[0], terms_one_by_one(made, renders)[0]
    for gradient, other in zip(gradients([value], renders), gradients([expected], renders), strict=True):
        assert_close(gradient, other)
    constant = prefix_terms(made, [r.detach() for r in renders])
    assert not any(value.requires_grad for value in constant)
    assert_close(constant[2], terms_one_by_one(made, renders)[2])


@pytest.mark.usefixtures("compiled_only")
def test_gradients_lie_one_behind_the_other():
    """So that a rasterizer of all prefixes needs no copy."""
    made, renders = case(3)
    first, *others = gradients(prefix_terms(made, renders), renders)
    for k, gradient in enumerate(others, start=1):
        assert gradient.data_ptr() == first.data_ptr() + k * first.numel() * first.element_size()


def test_what_has_no_kernels_is_computed_otherwise(monkeypatch):
    def refused(*_):
        raise AssertionError("compiled")

    monkeypatch.setattr(compiled_terms, "compiled_terms", refused)
    made, renders = case(3)
    small = case(3, size=(20, 64))
    half = [r.detach().half() for r in renders]
    learnt = replace(made, reduced=[r.clone().requires_grad_() for r in made.reduced])
    for other, images in ((replace(made, ssim_weight=0.0), renders), small, (made, half), (learnt, renders)):
        assert all(torch.isfinite(value) for value in prefix_terms(other, images))
