"""How much of each Gaussian is drawn: a weight in [0, 1] per row. Level of detail is one of these, passed to `render`.

Weights multiply opacities. Two attenuations combine by `Product`.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.types import Camera, Gaussians


@runtime_checkable
class Attenuation(Protocol):
    """Weight in [0, 1] of every Gaussian for one view."""

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]: ...


@dataclass(frozen=True)
class LevelCut:
    """The prefix of levels <= `level`; a fractional level k + t adds level k + 1 with its opacity times t.

    Continuous in `level`, and equal to the prefix at whole numbers. At or above the finest level everything is drawn.
    """

    level: float | int

    def __post_init__(self) -> None:
        if not self.level >= 0:
            raise ValueError(f"level is {self.level}; it must be a number >= 0 (0 draws nothing, 1 the base).")

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        whole = math.floor(min(self.level, 2**24))
        weight = (gaussians.level <= whole).to(gaussians.opacities.dtype)
        return weight + (self.level - whole if self.level < 2**24 else 0.0) * (gaussians.level == whole + 1)


@dataclass(frozen=True)
class SingleLevel:
    """The Gaussians of one level alone. This is no band image (that is the difference of two prefixes)."""

    level: int

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        return (gaussians.level == self.level).to(gaussians.opacities.dtype)


@dataclass(frozen=True)
class Product:
    """Several attenuations at once: the product of their weights; without any, 1."""

    parts: tuple[Attenuation, ...]

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        weight = torch.ones_like(gaussians.opacities)
        for part in self.parts:
            weight = weight * part(gaussians, camera)
        return weight
