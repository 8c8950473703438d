"""Detail in a part of the world: a ball around a point, whatever the camera."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class Ball:
    """An attenuation: Gaussians whose centres lie in a ball are drawn whole, of others only the lower levels.

    It knows places, not rows, so it holds while a scene is trained. The step at its surface is sharp.
    """

    centre: tuple[float, float, float]
    """world units"""
    radius: float | int
    """world units, > 0"""
    outside_level: int = 1
    """levels up to this one are drawn everywhere; 0: nothing outside of the ball"""

    def __post_init__(self) -> None:
        if not all(math.isfinite(coordinate) for coordinate in self.centre):
            raise ValueError(f"centre is {self.centre}; it must be three finite world coordinates.")
        if not 0 < self.radius < math.inf:
            raise ValueError(f"radius is {self.radius}; it must be a finite number > 0 (world units).")

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        means = gaussians.means.detach()
        x, y, z = ((means[:, axis] - self.centre[axis]) / self.radius for axis in range(3))
        # by hypot, so that no square overflows
        inside = torch.hypot(torch.hypot(x, y), z) <= 1
        return (inside | (gaussians.level <= self.outside_level)).to(gaussians.opacities)
