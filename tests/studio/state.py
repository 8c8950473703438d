"""What a trainer holds: to compare with another, and to see that it is in order."""

import torch
from torch.optim.lr_scheduler import LambdaLR


def parameters(model):
    return {name: p.detach().clone() for name, p in model.gauss_params.items()}


def all_finite(model):
    return all(bool(p.isfinite().all()) for p in model.parameters())


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def consistent(trainer):
    """One row per Gaussian everywhere: parameters, levels, optimizer states, statistics."""
    model = trainer.pipeline.model
    n = model.num_points
    assert model.level.shape == (n,) and model.level.dtype == torch.int32
    assert int(model.level.min()) >= 1 and int(model.level.max()) <= model.num_levels
    for name in model.gauss_params:
        parameter = model.gauss_params[name]
        optimizer = trainer.optimizers.optimizers[name]
        assert len(parameter) == n
        assert optimizer.param_groups[0]["params"] == [parameter]
        assert set(optimizer.state) <= {parameter}
        for key in ("exp_avg", "exp_avg_sq"):
            if parameter in optimizer.state:
                assert optimizer.state[parameter][key].shape == parameter.shape
    for key in ("grad2d", "count", "radii"):
        value = model.strategy_state[key]
        assert value is None or value.shape == (n,)
    assert "level" not in model.strategy_state


def optimizer_state(trainer):
    found = {}
    for name, optimizer in trainer.optimizers.optimizers.items():
        (parameter,) = optimizer.param_groups[0]["params"]
        found.update({f"{name}.{k}": v for k, v in optimizer.state.get(parameter, {}).items()})
        found[f"{name}.lr"] = torch.tensor(optimizer.param_groups[0]["lr"])
    for name, scheduler in trainer.optimizers.schedulers.items():
        assert isinstance(scheduler, LambdaLR)
        found[f"{name}.epoch"] = torch.tensor(scheduler.last_epoch)
    return found


def statistics(model):
    return {k: v for k, v in model.strategy_state.items() if torch.is_tensor(v)}
