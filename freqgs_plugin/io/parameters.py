"""Gaussians as they are trained and stored: logarithms of scales, logits of opacities."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.harmonics import num_coefficients
from freqgs_plugin.functional.similarity import Similarity

GROUPS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
"""splatfacto's parameter groups"""


@dataclass(frozen=True)
class RawGaussians:
    """Parameters of n Gaussians, by splatfacto's names and shapes. Nothing is activated."""

    means: Float[Tensor, "n 3"]
    """centres, units of their frame"""
    scales: Float[Tensor, "n 3"]
    """natural logarithms of standard deviations"""
    quats: Float[Tensor, "n 4"]
    """wxyz, any norm > 0"""
    features_dc: Float[Tensor, "n 3"]
    """coefficients of the constant harmonic, without the 0.5"""
    features_rest: Float[Tensor, "n k 3"]
    """the other coefficients, k = (degree + 1)^2 - 1"""
    opacities: Float[Tensor, "n 1"]
    """logits"""
    level: Int[Tensor, " n"] | None = None
    """Laplacian-pyramid level, 1..L"""
    decay: Float[Tensor, " n"] | None = None
    """sigma of distance decay"""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics, 0..4."""
        return round((self.features_rest.shape[1] + 1) ** 0.5) - 1

    def with_degree(self, degree: int) -> "RawGaussians":
        """The same with harmonics of another degree: cut off, or zeros added."""
        k, have = num_coefficients(degree) - 1, self.features_rest.shape[1]
        rest = self.features_rest[:, :k]
        if have < k:
            rest = torch.cat([rest, rest.new_zeros(len(self), k - have, 3)], 1)
        return replace(self, features_rest=rest)

    def moved(self, move: Similarity) -> "RawGaussians":
        """The same scene in another frame; untouched where the frames agree."""
        if move.is_identity():
            return self
        sh = move.harmonics(torch.cat([self.features_dc[:, None], self.features_rest], 1))
        return replace(
            self,
            means=move.points(self.means),
            scales=self.scales + torch.tensor(move.scale, dtype=torch.float64).log().to(self.scales.dtype),
            quats=move.quaternions(self.quats),
            features_dc=sh[:, 0],
            features_rest=sh[:, 1:],
        )
