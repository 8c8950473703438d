"""Change of frame by rotation, uniform scale and translation: of points, quaternions and spherical harmonics."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from freqgs_plugin.functional.harmonics import basis

_SAME = 1e-6
"""frames that differ by less are the same one: they are stored in float32"""
_ROTATION_TOLERANCE = 1e-3
"""largest entry of R R^T - 1 in what counts as a rotation"""


@dataclass(frozen=True)
class Similarity:
    """x -> scale * (rotation x + translation), as nerfstudio's `dataparser_transforms.json` says it."""

    rotation: Float[Tensor, "3 3"]
    """float64"""
    translation: Float[Tensor, " 3"]
    """float64, units before scaling"""
    scale: float

    def __post_init__(self) -> None:
        identity = torch.eye(3, dtype=self.rotation.dtype)
        error = float((self.rotation @ self.rotation.T - identity).abs().max())
        if not error < _ROTATION_TOLERANCE or float(torch.linalg.det(self.rotation)) < 0:
            raise ValueError(
                f"{self.rotation.tolist()} is no rotation; frames may differ by rotations only, not mirrored."
            )
        if not (0 < self.scale < float("inf")) or not bool(torch.isfinite(self.translation).all()):
            raise ValueError(
                f"scale {self.scale}, translation {self.translation.tolist()}: they must be finite, scale > 0."
            )

    @staticmethod
    def identity() -> "Similarity":
        return Similarity(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 1.0)

    def is_identity(self) -> bool:
        """Whether nothing moves, to the precision of float32."""
        shift = max(
            float((self.rotation - torch.eye(3, dtype=self.rotation.dtype)).abs().max()),
            float(self.translation.abs().max()),
            abs(self.scale - 1),
        )
        return shift < _SAME

    def inverse(self) -> "Similarity":
        """The way back."""
        rotation = self.rotation.T
        return Similarity(rotation, -self.scale * (rotation @ self.translation), 1 / self.scale)

    def after(self, first: "Similarity") -> "Similarity":
        """`first`, then this one."""
        return Similarity(
            self.rotation @ first.rotation,
            self.rotation @ first.translation + self.translation / first.scale,
            self.scale * first.scale,
        )

    def points(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points in the new frame, computed in float64."""
        return (self.scale * (x.double() @ self.rotation.T + self.translation)).to(x.dtype)

    def quaternions(self, quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
        """Orientations (wxyz, any norm, which stays) in the new frame."""
        x, y, z, w = (float(c) for c in Rotation.from_matrix(self.rotation.numpy()).as_quat())
        left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
        return (quats.double() @ left.T).to(quats.dtype)

    def harmonics(self, sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k 3"]:
        """Coefficients (k = (degree + 1)^2) of the same colours in the new frame's directions."""
        degree = round(sh.shape[1] ** 0.5) - 1
        return torch.einsum("ij,njc->nic", harmonics_rotation(self.rotation, degree), sh.double()).to(sh.dtype)


def harmonics_rotation(rotation: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "k k"]:
    """The matrix D with basis(R d) D c = basis(d) c for all directions d, k = (degree + 1)^2; float64.

    Solved from more directions than coefficients; harmonics up to a degree are closed under rotation, so that the
    solution is exact, and block by block: what couples different degrees is rounding error, and set to 0.
    """
    k = (degree + 1) ** 2
    directions = _spiral(4 * k).to(rotation)
    matrix = torch.linalg.lstsq(basis(directions @ rotation.T, degree), basis(directions, degree)).solution
    block = torch.tensor([np.sqrt(i) // 1 for i in range(k)])
    return torch.where(block[:, None] == block[None], matrix, 0.0)


def _spiral(n: int) -> Float[Tensor, "n 3"]:
    """n unit vectors spread over the sphere along a Fibonacci spiral."""
    i = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * i + 1) / n
    angle = i * np.pi * (3 - np.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
