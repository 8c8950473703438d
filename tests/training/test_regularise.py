"""Penalties and dropout: closed forms, laws, no Gaussians."""

import pytest
import torch

from freqgs_plugin.training.regularise import FEW_VIEWS, default_dropout, drop_out, opacity_shown, size_shown

ALL = torch.tensor([True, True])


def test_penalties_are_means_of_what_is_drawn():
    opacities = torch.tensor([0.5, 0.9])
    scales = torch.tensor([[1.0, 1.0, 1.0], [1.0, 2.0, 6.0]])
    assert opacity_shown(opacities, ALL).item() == pytest.approx(0.7)
    assert size_shown(scales, ALL).item() == pytest.approx(2)
    first = torch.tensor([True, False])
    assert opacity_shown(opacities, first).item() == pytest.approx(0.25)
    assert size_shown(scales, first).item() == pytest.approx(0.5)


def test_penalties_push_down_what_is_shown_and_nothing_else():
    opacities, scales = torch.zeros(2, requires_grad=True), torch.zeros(2, 3, requires_grad=True)
    shown = torch.tensor([True, False])
    (opacity_shown(opacities, shown) + size_shown(scales, shown)).backward()
    assert opacities.grad is not None and scales.grad is not None
    assert bool((opacities.grad[0] > 0).all()) and bool((scales.grad[0] > 0).all())
    assert bool((opacities.grad[1] == 0).all()) and bool((scales.grad[1] == 0).all())


def test_no_gaussians_cost_nothing():
    none = torch.zeros(0, dtype=torch.bool)
    assert opacity_shown(torch.zeros(0), none).item() == 0
    assert size_shown(torch.zeros(0, 3), none).item() == 0
    assert drop_out(torch.zeros(0), 0.5, 1, 2).shape == (0,)


def test_dropout_keeps_the_mean_and_the_share():
    dropped = drop_out(torch.full((100_000,), 0.3), 0.1, seed=1, step=7)
    assert (dropped == 0).float().mean().item() == pytest.approx(0.1, abs=0.005)
    assert dropped.mean().item() == pytest.approx(0.3, abs=0.003)
    assert dropped.max().item() == pytest.approx(0.3 / 0.9)


def test_dropout_depends_on_seed_and_step_alone():
    opacities = torch.rand(1000)
    torch.manual_seed(0)
    first = drop_out(opacities, 0.5, seed=1, step=7)
    torch.manual_seed(99)
    assert torch.equal(first, drop_out(opacities, 0.5, seed=1, step=7))
    assert not torch.equal(first, drop_out(opacities, 0.5, seed=1, step=8))
    assert not torch.equal(first, drop_out(opacities, 0.5, seed=2, step=7))


def test_rate_0_changes_nothing():
    opacities = torch.rand(10)
    assert torch.equal(drop_out(opacities, 0.0, 0, 0), opacities)


def test_only_few_views_call_for_dropout():
    assert default_dropout(FEW_VIEWS - 1) == 0.1
    assert default_dropout(FEW_VIEWS) == 0
