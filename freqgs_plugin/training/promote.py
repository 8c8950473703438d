"""A small base: of its Gaussians, those that its own pictures need least become Gaussians of level 2 (ours)."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.functional.harmonics import C0

_FROM, _TO = 1, 2
_COLOURS = ("features_dc", "features_rest")


def surplus(level: Int[Tensor, " n"], weight: Float[Tensor, " n"], share: float | int) -> Bool[Tensor, " n"]:
    """Which Gaussians of level 1 are too many, if it is to have at most `share` of all: those of least `weight`.

    One always stays.
    """
    base = torch.where(level == _FROM)[0]
    too_many = len(base) - max(int(share * len(level)), 1)
    rows = torch.zeros_like(level, dtype=torch.bool)
    if too_many > 0:
        rows[base[weight[base].argsort()[:too_many]]] = True
    return rows


@torch.no_grad()
def promote(params: Any, optimizers: Any, level: Int[Tensor, " n"], rows: Bool[Tensor, " n"], signed: bool) -> int:
    """Give `rows` of level 1 the level 2, in place; the picture of all levels stays the same. Returns how many.

    Args:
        params: raw parameters by group.
        optimizers: Adam by group; the moments of colours follow.
        level: of every Gaussian.
        rows: some of level 1.
        signed: levels above 1 hold colours 2 max(SH + 0.5, 0) - 1 (Eq. 4). Level 1 has max(SH + 0.5, 0) (Eq. 3), which
            is the same of SH / 2 + 1/4, but where that is clamped at 0: there a colour may now be negative.
    """
    level[rows] = _TO
    if not signed:
        return int(rows.sum())
    for name in _COLOURS:
        parameter = params[name]
        parameter[rows] /= 2
        state = optimizers[name].state.get(parameter, {})
        for key, factor in (("exp_avg", 2.0), ("exp_avg_sq", 4.0)):
            if key in state:
                state[key][rows] *= factor
    params["features_dc"][rows] += 0.25 / C0
    return int(rows.sum())
