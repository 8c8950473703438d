"""A base that is bounded: which Gaussians go to level 2, and that the picture of all levels does not change."""

import pytest
import torch

from freqgs_plugin.functional.harmonics import level_colours
from freqgs_plugin.training.promote import promote, surplus


def test_the_least_needed_of_the_base_are_its_surplus():
    level = torch.tensor([1, 1, 1, 1, 2, 2, 3, 3, 3, 3])
    weight = torch.tensor([5.0, 1.0, 3.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert surplus(level, weight, 0.2).nonzero().flatten().tolist() == [1, 3]
    assert not surplus(level, weight, 0.4).any() and not surplus(level, weight, 1).any()


def test_one_of_the_base_always_stays():
    rows = surplus(torch.ones(5, dtype=torch.long), torch.arange(5.0), 1e-9)
    assert rows.tolist() == [True, True, True, True, False]


def scene(degree=2, n=6):
    generator = torch.Generator().manual_seed(0)
    params = {
        # bright enough for no colour to be clamped
        "features_dc": torch.rand(n, 3, generator=generator) + 1,
        "features_rest": torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator) * 0.05,
    }
    params = {name: torch.nn.Parameter(value) for name, value in params.items()}
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    return params, optimizers, torch.tensor([1, 1, 1, 2, 3, 1])


ROWS = torch.tensor([True, False, True, False, False, False])
OFFSETS = torch.randn(6, 3, generator=torch.Generator().manual_seed(1))


def colours(params, level, signed):
    return level_colours(params["features_dc"], params["features_rest"], OFFSETS, level, signed)


@pytest.mark.parametrize("signed", [True, False])
def test_colours_stay_what_they_are(signed):
    params, optimizers, level = scene()
    before = colours(params, level, signed).detach()
    assert promote(params, optimizers, level, ROWS, signed) == 2
    assert level.tolist() == [2, 1, 2, 2, 3, 1]
    assert torch.allclose(colours(params, level, signed), before, atol=1e-6)


def test_a_colour_that_was_clamped_may_become_negative():
    params, optimizers, level = scene(degree=0)
    with torch.no_grad():
        params["features_dc"][0] = -3.0
    assert (colours(params, level, True)[0] == 0).all()
    promote(params, optimizers, level, ROWS, signed=True)
    assert (colours(params, level, True)[0] < 0).all()


def test_moments_are_those_of_the_new_parameters():
    """A step after the move is the step that fresh moments of the same history would take."""
    params, optimizers, level = scene()
    (colours(params, level, True) ** 2).sum().backward()
    for optimizer in optimizers.values():
        optimizer.step()
    states = {name: dict(optimizers[name].state[value]) for name, value in params.items()}
    before = {name: {k: states[name][k].clone() for k in ("exp_avg", "exp_avg_sq")} for name in params}
    promote(params, optimizers, level, ROWS, signed=True)
    for name, value in params.items():
        state = optimizers[name].state[value]
        for key, factor in (("exp_avg", 2.0), ("exp_avg_sq", 4.0)):
            assert torch.equal(state[key][ROWS], before[name][key][ROWS] * factor)
            assert torch.equal(state[key][~ROWS], before[name][key][~ROWS])
