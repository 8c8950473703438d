"""What can be left out of a trained scene: candidates, and the search for as many of them as a bound allows."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.functional.attenuation import TAU
from freqgs_plugin.types import Gaussians


@dataclass(frozen=True)
class Draft:
    """A scene from which something was left out."""

    gaussians: Gaussians
    rows: Int[Tensor, " n"]
    """which of the run's Gaussians these are"""
    unseen: tuple[Gaussians, ...] = ()
    """the same made without looking at the training views of even number, and without those of odd number"""

    @classmethod
    def of(cls, gaussians: Gaussians) -> "Draft":
        """The whole scene."""
        return cls(gaussians, torch.arange(len(gaussians), device=gaussians.means.device))

    def __len__(self) -> int:
        return len(self.gaussians)

    def keep(self, rows: Bool[Tensor, " n"]) -> "Draft":
        """Those in `rows`."""
        return Draft(self.gaussians.select(rows), self.rows[rows])


def finite_rows(gaussians: Gaussians) -> Bool[Tensor, " n"]:
    """Gaussians with numbers in all parameters: others cannot be drawn at all."""
    g = gaussians
    columns = [g.means, g.quats, g.scales, g.opacities[:, None], g.features_dc, g.features_rest.flatten(1)]
    if g.decay is not None:
        columns.append(g.decay[:, None])
    return torch.stack([torch.isfinite(column).all(1) for column in columns]).all(0)


def never_drawn(gaussians: Gaussians) -> Bool[Tensor, " n"]:
    """What no rasterizer composites, from wherever: opacity under 1/255, a dead decay, values that are not finite."""
    g = gaussians
    dead = ~finite_rows(g) | (g.opacities < TAU) | (g.quats == 0).all(1)
    return dead if g.decay is None else dead | ~(g.decay > 0)


def faintest(weight: Float[Tensor, " n"], level: Int[Tensor, " n"], count: int) -> Bool[Tensor, " n"]:
    """The `count` Gaussians of least weight; the weightiest of level 1 never."""
    drop = torch.zeros(len(weight), dtype=torch.bool, device=weight.device)
    drop[torch.argsort(weight, stable=True)[:count]] = True
    base = torch.where(level == 1)[0]
    if len(base):
        drop[base[weight[base].argmax()]] = False
    return drop


def most(largest: int, fits: Callable[[int], bool], tries: int = 10) -> int:
    """The largest number in 0..`largest` that fits, by bisection: what fits is taken to be an interval from 0.

    0 is not tried. At most `tries` numbers are: the answer then is one that fits, up to 2^-tries of `largest` less.
    """
    low, high = 0, largest + 1
    while high - low > 1 and tries > 0:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
        tries -= 1
    return low


def highest(low: float, high: float, fits: Callable[[float], bool], tries: int = 9) -> float | None:
    """`most` for a positive number in `low`..`high`, on a logarithmic scale; None if not even `low` fits."""
    if not fits(low):
        return None
    a, b = math.log(low), math.log(high)
    for _ in range(tries):
        middle = (a + b) / 2
        a, b = (middle, b) if fits(math.exp(middle)) else (a, middle)
    return math.exp(a)


def without_empty_levels(level: Int[Tensor, " n"]) -> tuple[Int[Tensor, " n"], list[int]]:
    """Levels renumbered 1.. without gaps, and the old numbers of those that hold Gaussians, in order."""
    present = torch.unique(level)
    return torch.searchsorted(present, level).to(level.dtype) + 1, present.tolist()


def decay_never_cuts(margin: Float[Tensor, " n"], without: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Where a decay does not decide whether a Gaussian is drawn; both margins are ln(opacity / threshold)."""
    return (margin > 0) == (without > 0)


def without_decay(draft: Draft) -> Draft:
    """The same without distance decay."""
    return replace(draft, gaussians=replace(draft.gaussians, decay=None), unseen=())
