import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from freqgs_plugin.functional.harmonics import C0, basis, evaluate, evaluate_in_torch, level_colours, num_coefficients


def random_sh(degree, n=50, dtype=torch.float64):
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


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_compiled_equals_torch_in_value_and_gradient(degree, assert_close):
    sh, offsets = random_sh(degree)
    weight = torch.randn(50, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    exact = [t.clone().requires_grad_() for t in (sh, offsets)]
    fast = [t.float().requires_grad_() for t in (sh, offsets)]
    expected, actual = (
        function(sh[:, 0], sh[:, 1:], offsets)
        for function, (sh, offsets) in ((evaluate_in_torch, exact), (evaluate, fast))
    )
    (expected * weight).sum().backward()
    (actual * weight.float()).sum().backward()
    assert_close(actual, expected)
    for a, b, name in zip(fast, exact, ("sh", "offsets"), strict=True):
        assert_close(a.grad, b.grad, message=name)


def test_no_direction_at_the_camera_centre():
    sh, _ = random_sh(3, dtype=torch.float32)
    offsets = torch.zeros(50, 3, requires_grad=True)
    out = evaluate(sh[:, 0], sh[:, 1:], offsets)
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
