"""Training over virtual distances: the scale of each step, what it weighs, and the loss on the number of Gaussians.

Equation numbers are those of the paper on continuous level of detail (CLoD-GS, 3.3).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

CountGradient = Literal["none", "ste", "soft"]
"""gradient of the number of drawn Gaussians: `none` (the paper's mask is a step), `ste`: counted exactly, with the
gradient of a sigmoid; `soft`: the sum of those sigmoids itself"""
_EXPONENT = 1.5
"""how fast the target share falls with the scale (Eq. 3)"""


@dataclass(frozen=True)
class DetailSampling:
    """The virtual distance scale s_v of every step, drawn from U(1, largest).

    It depends on the seed and the step alone, so a resumed run draws what the whole run would have drawn.
    """

    start: int
    """step at which the decay begins to act"""
    largest: float | int
    """s_max, at least 1"""
    seed: int
    full_detail_every: int = 0
    """every so many steps the scale is 1; 0: only by chance"""

    def active(self, step: int) -> bool:
        """Whether opacities decay with distance at `step`."""
        return step >= self.start

    def scale(self, step: int, held: bool = False) -> float:
        """s_v of `step`; 1 before the start, and where `held` says that opacities recover from a reset."""
        full = self.full_detail_every > 0 and step % self.full_detail_every == 0
        if held or full or not self.active(step):
            return 1.0
        # the last number keeps this apart from other draws of the step
        return float(np.random.default_rng((self.seed, step, 1)).uniform(1.0, self.largest))

    def loss_weight(self, scale: float) -> float:
        """w_s = (1 - s_v / (2 s_max))^2: the farther, the less a step counts (Eq. 5)."""
        return (1.0 - 0.5 * scale / self.largest) ** 2


def target_share(scale: float | int) -> float:
    """Share of all Gaussians that may be drawn at `scale` without a penalty (Eq. 3)."""
    return float(scale) ** -_EXPONENT


def count_loss(
    margin: Float[Tensor, " n"],
    scale: float | int,
    largest: float | int,
    gradient: CountGradient = "ste",
    temperature: float | int = 0.5,
) -> Float[Tensor, ""]:
    """(s_v - 1)^2 max(share drawn - target share, 0)^2, over all Gaussians (Eq. 4); 0 without Gaussians.

    With a gradient, the first factor is ((s_v - 1) / (s_max - 1))^2: unnormalised it reaches 36 at s_max = 7, hundreds
    of times the image loss.

    Args:
        margin: ln α'' - ln(τ s_v) (`DistanceDecay.margin`): a Gaussian is drawn where this is positive.
        scale: s_v, at least 1.
        largest: s_max.
        gradient: see `CountGradient`.
        temperature: width of the sigmoid, in units of `margin`.
    """
    if scale == 1 or not len(margin):
        return margin.sum() * 0.0
    drawn = (margin > 0).to(margin.dtype).mean()
    fades = torch.sigmoid(margin / temperature)
    # what is not drawn at this scale must not sink further, or it would be missing at smaller ones
    sinks = torch.where(margin > 0, fades, fades.detach()).mean()
    shares = {"none": drawn, "ste": sinks + (drawn - sinks).detach(), "soft": fades.mean()}
    weight = (scale - 1.0) ** 2 if gradient == "none" else ((scale - 1.0) / (largest - 1.0)) ** 2
    return weight * torch.relu(shares[gradient] - target_share(scale)).square()
