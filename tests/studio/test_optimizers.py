import copy
import io

import pytest
import torch
from nerfstudio.engine.optimizers import Optimizers

from freqgs_plugin.studio.optimizers import adopt_parameters, fuse, restart, scale_schedulers, set_rate
from method_configs.optimizers import splat_optimizers


@pytest.fixture
def groups():
    return {name: [torch.nn.Parameter(torch.randn(4, 3))] for name in ("means", "scales")}


@pytest.fixture
def optimizers(groups):
    table = splat_optimizers()
    return Optimizers({name: table[name] for name in groups}, groups)


def step(optimizers, times=1):
    for _ in range(times):
        optimizers.zero_grad_all()
        sum((p[0] ** 2).sum() for p in optimizers.parameters.values()).backward()
        optimizers.optimizer_step_all()
        for scheduler in optimizers.schedulers.values():
            scheduler.step()


def rate(optimizers, name="means"):
    return optimizers.optimizers[name].param_groups[0]["lr"]


def test_new_parameters_keep_the_optimizer_state(optimizers, groups):
    step(optimizers, 3)
    old = {n: dict(o.state[groups[n][0]]) for n, o in optimizers.optimizers.items()}
    new = {n: [torch.nn.Parameter(p[0].detach().clone())] for n, p in groups.items()}
    adopt_parameters(optimizers, new)
    for name, optimizer in optimizers.optimizers.items():
        assert optimizer.param_groups[0]["params"] == new[name] == optimizers.parameters[name]
        assert list(optimizer.state) == new[name]
        for key, value in old[name].items():
            assert torch.equal(optimizer.state[new[name][0]][key], value)
    before = new["means"][0].detach().clone()
    step(optimizers)
    assert not torch.equal(new["means"][0], before)


def test_fused_steps_are_the_same_steps(optimizers, groups):
    other_groups = {n: [torch.nn.Parameter(p[0].detach().clone())] for n, p in groups.items()}
    table = splat_optimizers()
    fused = Optimizers({name: table[name] for name in groups}, other_groups)
    fuse(fused, other_groups)
    assert all(o.param_groups[0]["fused"] for o in fused.optimizers.values())
    step(optimizers, 5)
    step(fused, 5)
    for name in groups:
        torch.testing.assert_close(other_groups[name][0], groups[name][0], rtol=1e-6, atol=1e-7)


def test_parameters_without_state_are_adopted_too(optimizers, groups):
    new = {n: [torch.nn.Parameter(torch.zeros(9, 3))] for n in groups}
    adopt_parameters(optimizers, new)
    assert not optimizers.optimizers["means"].state
    assert optimizers.parameters["means"][0].shape == (9, 3)


def test_a_loaded_state_of_another_length_fits_afterwards(optimizers, groups):
    """As the trainer does: optimizers are made for the seed points and load the state of the trained Gaussians."""
    big = {n: [torch.nn.Parameter(torch.randn(7, 3))] for n in groups}
    table = splat_optimizers()
    trained = Optimizers({name: table[name] for name in groups}, big)
    step(trained, 2)
    optimizers.load_optimizers(copy.deepcopy({n: o.state_dict() for n, o in trained.optimizers.items()}))
    loaded = {n: [torch.nn.Parameter(p[0].detach().clone())] for n, p in big.items()}
    adopt_parameters(optimizers, loaded)
    for optimizer in (trained, optimizers):
        step(optimizer)
    assert all(torch.equal(loaded[n][0], big[n][0]) for n in groups)


@pytest.mark.parametrize("scale", [0.01, 0.1, 1.0, 3.0])
def test_schedules_are_stretched(optimizers, scale):
    start, end = 1.6e-4, 1.6e-6
    scale_schedulers(optimizers, scale)
    (function,) = optimizers.schedulers["means"].lr_lambdas
    for share in (0.0, 0.25, 0.5, 1.0, 2.0):
        expected = start * (end / start) ** min(share, 1.0)
        assert start * function(share * 30_000 * scale) == pytest.approx(expected, rel=1e-6)


def test_rates_are_plain_numbers_that_a_safe_load_accepts(optimizers):
    scale_schedulers(optimizers, 0.1)
    step(optimizers, 5)
    state = {
        "optimizers": {n: o.state_dict() for n, o in optimizers.optimizers.items()},
        "schedulers": {n: s.state_dict() for n, s in optimizers.schedulers.items()},
    }
    for group in (o["param_groups"][0] for o in state["optimizers"].values()):
        assert type(group["lr"]) is float
    schedule = state["schedulers"]["means"]
    assert {type(v) for v in schedule["base_lrs"] + schedule["_last_lr"]} == {float}
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    assert torch.load(file, weights_only=True)["schedulers"]["means"]["last_epoch"] == 5


def test_a_loaded_schedule_goes_on_where_it_was(optimizers, groups):
    scale_schedulers(optimizers, 0.01)
    step(optimizers, 40)
    table = splat_optimizers()
    other = Optimizers({name: table[name] for name in groups}, groups)
    other.load_schedulers({n: s.state_dict() for n, s in optimizers.schedulers.items()})
    scale_schedulers(other, 0.01)
    assert rate(other) == pytest.approx(rate(optimizers), rel=1e-12)
    step(other)
    step(optimizers)
    assert rate(other) == pytest.approx(rate(optimizers), rel=1e-12)


@pytest.mark.parametrize("schedulers", [True, False])
def test_restart(optimizers, schedulers):
    scale_schedulers(optimizers, 0.01)
    first = rate(optimizers)
    step(optimizers, 100)
    decayed = rate(optimizers)
    assert decayed < 0.5 * first
    restart(optimizers, ("means", "scales"), schedulers)
    assert not optimizers.optimizers["means"].state and not optimizers.optimizers["scales"].state
    assert rate(optimizers) == (pytest.approx(first) if schedulers else decayed)
    step(optimizers)
    assert rate(optimizers) < (first if schedulers else decayed)


@pytest.mark.parametrize("name", ["means", "scales"])
def test_a_rate_is_set_with_and_without_a_schedule(optimizers, name):
    step(optimizers, 5)
    before = rate(optimizers, name) / (1.6e-4 if name == "means" else 0.005)
    set_rate(optimizers, name, 3.0)
    assert rate(optimizers, name) == pytest.approx(3.0 * before)
    step(optimizers)
    assert 2.9 < rate(optimizers, name) <= 3.0
