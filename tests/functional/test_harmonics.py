import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from freqgs_plugin.functional.harmonics import (
    C0,
    basis,
    evaluate,
    level_colours,
    level_colours_in_torch,
    num_coefficients,
)


def random_sh(degree, n=150, dtype=torch.float64):
    generator = torch.Generator().manual_seed(degree)
    sh = torch.randn(n, num_coefficients(degree), 3, generator=generator, dtype=dtype)
    return sh, torch.randn(n, 3, generator=generator, dtype=dtype)


@pytest.mark.parametrize("degree", range(5))
def test_equals_gsplat(degree):
    sh, offsets = random_sh(degree)
    expected = _spherical_harmonics(degree, offsets, sh)
    torch.testing.assert_close(evaluate(sh[:, 0], sh[:, 1:], offsets), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degree", range(5))
def test_basis_is_orthonormal(degree):
    """Monte Carlo over a spherical Fibonacci lattice."""
    n = 20_000
    k = torch.arange(n, dtype=torch.float64) + 0.5
    z, phi = 1 - 2 * k / n, torch.pi * (1 + 5**0.5) * k
    r = (1 - z * z).sqrt()
    b = basis(torch.stack([r * phi.cos(), r * phi.sin(), z], -1), degree)
    gram = b.T @ b * (4 * torch.pi / n)
    torch.testing.assert_close(gram, torch.eye(len(gram), dtype=torch.float64), rtol=0, atol=1e-3)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compiled_equals_torch_in_value_and_gradient(degree, signed, assert_close):
    sh, offsets = random_sh(degree)
    level = torch.arange(150, dtype=torch.int32) % 3 + 1
    weight = torch.randn(150, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    exact = [t.clone().requires_grad_() for t in (sh, offsets)]
    fast = [t.float().requires_grad_() for t in (sh, offsets)]
    expected, actual = (
        function(sh[:, 0], sh[:, 1:], offsets, level, signed)
        for function, (sh, offsets) in ((level_colours_in_torch, exact), (level_colours, fast))
    )
    assert (expected == 0).any() if not signed else (expected == -1).any(), "some are clamped"
    (expected * weight).sum().backward()
    (actual * weight.float()).sum().backward()
    assert_close(actual, expected)
    for a, b, name in zip(fast, exact, ("sh", "offsets"), strict=True):
        # colours of degree 0 have no direction
        assert_close(a.grad, torch.zeros_like(b) if b.grad is None else b.grad, message=name)


@pytest.mark.parametrize("function", [level_colours, level_colours_in_torch])
def test_a_clamped_colour_has_no_gradient_and_nan_stays(function):
    dc = (torch.tensor([[0.1, -0.1, float("nan")]]) - 0.5).div(C0).requires_grad_()
    colour = function(dc, torch.zeros(1, 3, 3), torch.ones(1, 3), torch.ones(1, dtype=torch.int32), True)
    torch.testing.assert_close(colour, torch.tensor([[0.1, 0.0, float("nan")]]), equal_nan=True)
    colour.sum().backward()
    assert dc.grad is not None
    torch.testing.assert_close(dc.grad[0, :2], torch.tensor([C0, 0.0]))


def test_infinite_coefficients_of_what_is_not_seen():
    sh, offsets = random_sh(3, n=70, dtype=torch.float32)
    sh[66, 5] = float("inf")
    sh.requires_grad_()
    offsets.requires_grad_()
    colours = level_colours(sh[:, 0], sh[:, 1:], offsets, torch.ones(70, dtype=torch.int32), True)
    assert colours[:66].isfinite().all()
    colours[:66].sum().backward()
    assert sh.grad is not None and offsets.grad is not None
    assert sh.grad.isfinite().all() and offsets.grad.isfinite().all() and not sh.grad[66:].any()


def test_no_direction_at_the_camera_centre():
    sh, _ = random_sh(3, dtype=torch.float32)
    level = torch.ones(150, dtype=torch.int32)
    for function in (level_colours, level_colours_in_torch):
        offsets = torch.zeros(150, 3, requires_grad=True)
        out = function(sh[:, 0], sh[:, 1:], offsets, level, False)
        out.sum().backward()
        assert torch.isfinite(out).all() and torch.isfinite(offsets.grad).all()


def test_colours_of_levels():
    """Eq. 3 at level 1, Eq. 4 above it."""
    sh = (torch.tensor([[0.2, 0.5, 0.9], [0.2, 0.5, 0.9], [-1.0, 0.0, 2.0]]) - 0.5)[:, None] / C0
    level = torch.tensor([1, 2, 3])
    colours = level_colours(sh[:, 0], sh[:, 1:], torch.ones(3, 3), level, True)
    expected = torch.tensor([[0.2, 0.5, 0.9], [-0.6, 0.0, 0.8], [-1.0, -1.0, 3.0]])
    torch.testing.assert_close(colours, expected)
    unsigned = level_colours(sh[:, 0], sh[:, 1:], torch.ones(3, 3), level, False)
    torch.testing.assert_close(unsigned[1:], torch.tensor([[0.2, 0.5, 0.9], [0.0, 0.0, 2.0]]))


def test_bad_degree_is_named():
    with pytest.raises(ValueError, match=r"degree 5 is outside of 0\.\.4"):
        num_coefficients(5)
