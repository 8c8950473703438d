"""Which Gaussians of a model without decay are kept at a given count: what learned decays have to beat."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.budget import DecayBudget, in_view
from freqgs_plugin.types import Camera, Gaussians

_LEAST_SCALE = 1e-6
"""s_v has to go below 1 where sigma is so small that Gaussians are gone at full detail"""


@dataclass(frozen=True)
class MostOpaque:
    """The `count` most opaque Gaussians, as they are; nothing else is drawn. Of equal ones, those of the first rows."""

    count: int
    within_view: bool = True
    """count, and draw, only what is in view; off: the same Gaussians for every view"""

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        weight = torch.zeros_like(gaussians.opacities)
        rows = torch.arange(len(weight), device=weight.device)
        if self.within_view:
            rows = rows[in_view(gaussians, camera)]
        opacities = gaussians.opacities.detach()[rows]
        weight[rows[torch.sort(opacities, descending=True, stable=True).indices[: self.count]]] = 1.0
        return weight


@dataclass(frozen=True)
class SharedDecay:
    """The paper's attenuation (Eq. 2) with one σ for all: s_v such that `count` Gaussians in view are drawn.

    The paper chooses Gaussians of a plain model so. Cut hard; only `count` and σ matter for which ones are chosen: the
    larger σ, the less distance counts against opacity.
    """

    count: int
    decay: float | int
    """sigma, in units of `scene_distance`"""
    scene_distance: float | int
    """world units"""
    fade: bool = True
    """opacities are those of the formula; off: it only chooses, and Gaussians keep their own opacities"""

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        shared = replace(gaussians, decay=torch.full_like(gaussians.opacities, self.decay))
        budget = DecayBudget(self.count, scene_distance=self.scene_distance, soft=False, least=_LEAST_SCALE)
        weight = budget(shared, camera)
        return weight if self.fade else (weight > 0).to(weight.dtype)
