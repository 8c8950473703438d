"""Frozen dataclasses that travel between the layers, with shapes, units and axes.

Camera axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5. Quaternions are wxyz.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """A scene: 3D Gaussians with activated parameters (no logits, no logarithms).

    Levels are numbered 1..L as in the Laplacian-pyramid paper: 1 is the base (coarsest), L the finest.
    """

    means: Float[Tensor, "n 3"]
    """centres, world units"""
    quats: Float[Tensor, "n 4"]
    """rotations, wxyz, any norm > 0"""
    scales: Float[Tensor, "n 3"]
    """standard deviations along the rotated axes, world units"""
    opacities: Float[Tensor, " n"]
    """in [0, 1]"""
    features_dc: Float[Tensor, "n 3"]
    """spherical-harmonic coefficients of the colour, degree 0"""
    features_rest: Float[Tensor, "n k 3"]
    """the others, k = (degree + 1)^2 - 1: apart, as they are trained, because joining them copies all of them"""
    level: Int[Tensor, " n"]
    """Laplacian-pyramid level, 1..L"""
    signed_residuals: bool = True
    """levels above 1 hold colours in [-1, inf) instead of [0, inf) (Eq. 4 against Eq. 3)"""
    decay: Float[Tensor, " n"] | None = None
    """sigma of the distance decay, in normalised distances; at or below 0: dead. None: opacities do not decay"""

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Tensor) -> "Gaussians":
        """The Gaussians at `rows` (a boolean mask [n] or indices)."""
        rows = _indices(rows)
        return Gaussians(
            means=self.means.index_select(0, rows),
            quats=self.quats.index_select(0, rows),
            scales=self.scales.index_select(0, rows),
            opacities=self.opacities.index_select(0, rows),
            features_dc=self.features_dc.index_select(0, rows),
            features_rest=self.features_rest.index_select(0, rows),
            level=self.level.index_select(0, rows),
            signed_residuals=self.signed_residuals,
            decay=None if self.decay is None else self.decay.index_select(0, rows),
        )


@dataclass(frozen=True)
class Camera:
    """One pinhole view."""

    viewmat: Float[Tensor, "4 4"]
    """world to camera, OpenCV axes"""
    K: Float[Tensor, "3 3"]
    """intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels"""
    width: int
    """pixels"""
    height: int
    """pixels"""

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Camera centre in the world, -R^T t; no matrix product, which autocast would take in half precision."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -(rotation * translation[:, None]).sum(0)


@dataclass(frozen=True)
class Splats:
    """Gaussians of one view, ready to composite."""

    means: Float[Tensor, "n 3"]
    """world"""
    quats: Float[Tensor, "n 4"]
    """wxyz, any norm > 0"""
    scales: Float[Tensor, "n 3"]
    """standard deviations, world units"""
    opacities: Float[Tensor, " n"]
    """[0, 1], already attenuated"""
    features: Float[Tensor, "n d"]
    """colours or anything else; may be negative"""

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Tensor) -> "Splats":
        """The splats at `rows` (a boolean mask [n] or indices)."""
        rows = _indices(rows)
        return Splats(
            means=self.means.index_select(0, rows),
            quats=self.quats.index_select(0, rows),
            scales=self.scales.index_select(0, rows),
            opacities=self.opacities.index_select(0, rows),
            features=self.features.index_select(0, rows),
        )


@dataclass(frozen=True)
class Rendering:
    """What a rasterizer returns for one camera."""

    features: Float[Tensor, "h w d"]
    """composited features, not clamped"""
    alpha: Float[Tensor, "h w 1"]
    """accumulated opacity, [0, 1]"""
    depth: Float[Tensor, "h w 1"]
    """expected camera z (weighted mean over what was hit), world units; 0 where nothing was hit; no gradient"""
    info: dict[str, Any] = field(default_factory=dict)
    """gsplat's keys for the densification strategy: means2d, radii, width, height, n_cameras ..."""


def _indices(rows: Tensor) -> Tensor:
    """A mask searched once instead of once per tensor."""
    return rows.nonzero().squeeze(1) if rows.dtype == torch.bool else rows
