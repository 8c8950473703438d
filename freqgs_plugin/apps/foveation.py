"""Detail where one looks: weights that fall off around a gaze, the faster the finer the level.

Section 4.5 and supplement 1.2 of the Laplacian-pyramid paper, which names neither threshold nor widths: both are ours,
and so is the disc in which nothing is taken away.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import TAU
from freqgs_plugin.functional.projection import NEAR_PLANE
from freqgs_plugin.types import Camera, Gaussians

_FAR = 1e6
"""image widths; what projects farther away, or lies behind the camera, counts as this far"""


@dataclass(frozen=True)
class Foveation:
    """An attenuation for one gaze: a Gaussian's weight falls with the distance from a disc around it to its centre.

    The standard deviation of level k of L is `sigma` 2^(L-k): it halves from level to level, and is `sigma` at the
    finest. In the disc, and of level 1 everywhere, the weight is 1. With `radius` 0 it is the paper's.
    """

    gaze: tuple[float, float]
    """where one looks: shares of the image's width and height, from its upper left corner. It may lie outside"""
    sigma: float | int = 0.1
    """standard deviation of the finest level, share of the image's longer side, > 0"""
    radius: float | int = 0.1
    """of the disc, share of the image's longer side, >= 0"""
    threshold: float | int = TAU
    """opacity times weight under which a Gaussian is left out before it is projected, [0, 1]"""

    def __post_init__(self) -> None:
        if not all(math.isfinite(share) for share in self.gaze):
            raise ValueError(f"gaze is {self.gaze}; it must be two numbers (0.5, 0.5 is the middle of the image).")
        if not 0 < self.sigma < math.inf:
            raise ValueError(f"sigma is {self.sigma}; it must be a finite number > 0 (a share of the longer side).")
        if not 0 <= self.radius < math.inf:
            raise ValueError(f"radius is {self.radius}; it must be a finite number >= 0 (a share of the longer side).")
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"threshold is {self.threshold}; it must be an opacity from 0 to 1.")

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        if not len(gaussians):
            return torch.ones_like(gaussians.opacities)
        level = gaussians.level
        finest = int(level.max())
        above = (finest - level).to(gaussians.opacities.dtype)
        outside = (self._eccentricity(gaussians, camera) - self.radius).clamp_min(0.0)
        weight = torch.exp(-0.5 * (outside / (self.sigma * torch.exp2(above))).square())
        weight = torch.where(gaussians.opacities * weight > self.threshold, weight, 0.0)
        return torch.where(level > 1, weight, 1.0)

    @torch.no_grad()
    def _eccentricity(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        """Distance on the image plane from the gaze to each projected centre, in lengths of the longer side."""
        means, viewmat, intrinsics = gaussians.means, camera.viewmat.to(gaussians.means), camera.K.to(gaussians.means)
        # one column at a time: autocast would take a matrix product in half precision
        x, y, z = (
            sum((viewmat[i, j] * means[:, j] for j in range(3)), viewmat[i, 3].expand(len(means))) for i in range(3)
        )
        front = z > NEAR_PLANE
        depth = torch.where(front, z, 1.0)
        longer = max(camera.width, camera.height)
        u = (intrinsics[0, 0] * x / depth + intrinsics[0, 2] - self.gaze[0] * camera.width) / longer
        v = (intrinsics[1, 1] * y / depth + intrinsics[1, 2] - self.gaze[1] * camera.height) / longer
        return torch.where(front, torch.hypot(u, v).clamp_max(_FAR), _FAR)
