"""Whether a run's numbers are sound: its parameters, its pictures, and what happened in training."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.reports.report.training_log import TrainingLog

THINNEST = (torch.finfo(torch.float32).eps / 2) ** 0.5
"""1/4096 of the longest standard deviation: below, the shortest one's square is lost beside the longest one's"""


def health(run: Any, clamped: Mapping[str, Any], log: TrainingLog) -> dict[str, Any]:
    """Of a run at full detail; `clamped` is what was measured of its pictures."""
    return {
        "clamped": dict(clamped),
        "dead_decay": _dead(run),
        "scales": scale_health(run.gaussians.scales),
        "parameters": _non_finite({name: p.detach() for name, p in run.model.gauss_params.items()}),
        "training": _events(run.model.guard, log),
    }


def scale_health(scales: Float[Tensor, "n 3"]) -> dict[str, Any]:
    """Near-degenerate Gaussians: so thin beside their length that a float32 covariance does not hold the thin side."""
    finite = scales[scales.isfinite().all(-1)]
    if not len(finite):
        return {"near_degenerate": 0, "share": 0.0, "smallest": None, "largest": None, "largest_ratio": None}
    short, long = finite.amin(-1), finite.amax(-1)
    degenerate: Bool[Tensor, " n"] = short <= THINNEST * long
    return {
        "near_degenerate": int(degenerate.sum()),
        "share": float(degenerate.float().mean()),
        "smallest": float(short.min()),
        "largest": float(long.max()),
        # a thickness of 0 has no ratio
        "largest_ratio": float((long / short).max()) if bool((short > 0).all()) else None,
    }


def _dead(run: Any) -> dict[str, Any] | None:
    """Gaussians whose sigma is at or below 0, or at the bound that holds it; None: opacities do not decay."""
    decay = run.gaussians.decay
    if decay is None:
        return None
    config = run.config.pipeline.model
    held = config.dead_decay == "keep"
    bound = config.least_decay if held else 0.0
    dead = int((decay <= bound).sum())
    return {"count": dead, "share": dead / max(len(decay), 1), "bound": bound, "held": held}


def _non_finite(parameters: Mapping[str, Tensor]) -> dict[str, int]:
    """Parameter -> Gaussians with a value that is not finite; only those that have any."""
    counts = {name: int((~p.isfinite()).flatten(1).any(-1).sum()) for name, p in parameters.items()}
    return {name: count for name, count in counts.items() if count}


def _events(guard: Any, log: TrainingLog) -> dict[str, Any]:
    """Steps that were skipped because a loss or gradient was not finite.

    The checkpoint knows the very first step. Where it was written before checkpoints kept it, the log knows by which
    logged step one had been skipped.
    """
    from_log = not guard.complete
    known = log.skipped is not None or not from_log
    first = log.first_skipped if from_log else guard.first_step
    return {
        "skipped_steps": (log.skipped if from_log else guard.skipped) if known else None,
        "first_step": first,
        "exact": not from_log,
        "what": guard.first,
        "scalars": dict(log.non_finite),
    }
