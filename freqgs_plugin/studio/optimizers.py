"""nerfstudio's optimizers: rebinding after a checkpoint was loaded, schedules of another length, restarts."""

from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch.optim.lr_scheduler import LambdaLR


def adopt_parameters(optimizers: Optimizers, groups: dict[str, list[Any]]) -> None:
    """Point each optimizer at the model's present parameters, keeping its state.

    Loading a checkpoint replaces the Gaussians' parameters after the trainer has made its optimizers.
    """
    for name, params in groups.items():
        optimizer = optimizers.optimizers[name]
        old = optimizer.param_groups[0]["params"]
        states = [optimizer.state.pop(p, {}) for p in old]
        optimizer.param_groups[0]["params"] = list(params)
        optimizers.parameters[name] = list(params)
        for parameter, state in zip(params, states, strict=True):
            if state:
                optimizer.state[parameter] = {
                    key: value.to(parameter.device) if hasattr(value, "to") and value.dim() else value
                    for key, value in state.items()
                }


def fuse(optimizers: Optimizers, groups: dict[str, list[Any]]) -> None:
    """Have Adam move parameters on the CPU in one pass over memory: half the time of its one pass per operation."""
    for name, params in groups.items():
        optimizer = optimizers.optimizers[name]
        if isinstance(optimizer, torch.optim.Adam) and all(p.device.type == "cpu" for p in params):
            for group in optimizer.param_groups:
                group["fused"] = True


def scale_schedulers(optimizers: Optimizers, scale: float) -> None:
    """Stretch learning rate schedules to a run `scale` times the one that they were written for.

    Rates become Python floats: nerfstudio's are numpy scalars, which torch refuses to load from a checkpoint.
    """
    for name, scheduler in optimizers.schedulers.items():
        if isinstance(scheduler, LambdaLR):
            scheduler.lr_lambdas = [_stretched(f, scale) for f in scheduler.lr_lambdas]
            _apply(optimizers, name, scheduler)


def set_rate(optimizers: Optimizers, name: str, rate: float) -> None:
    """Make `rate` the learning rate of group `name`, or the one that its schedule begins with."""
    scheduler = optimizers.schedulers.get(name)
    if isinstance(scheduler, LambdaLR):
        scheduler.base_lrs = [rate]
        _apply(optimizers, name, scheduler)
    else:
        optimizers.optimizers[name].param_groups[0]["lr"] = rate


def restart(optimizers: Optimizers, names: tuple[str, ...], schedulers: bool) -> None:
    """Forget the state of the optimizers in `names` and, if asked, begin their schedules anew."""
    for name in names:
        optimizers.optimizers[name].state.clear()
        scheduler = optimizers.schedulers.get(name)
        if schedulers and isinstance(scheduler, LambdaLR):
            scheduler.last_epoch = 0
            _apply(optimizers, name, scheduler)


def _stretched(function: Any, scale: float) -> Any:
    return lambda step: float(function(step / scale))


def _apply(optimizers: Optimizers, name: str, scheduler: LambdaLR) -> None:
    """Set the rates that the schedule has at its present step."""
    groups = optimizers.optimizers[name].param_groups
    for group, base, function in zip(groups, scheduler.base_lrs, scheduler.lr_lambdas, strict=True):
        group["lr"] = float(base) * function(scheduler.last_epoch)
        group["initial_lr"] = float(group["initial_lr"])
    scheduler.base_lrs = [float(base) for base in scheduler.base_lrs]
    scheduler._last_lr = [group["lr"] for group in groups]
