"""Where things are, asked of a prefix of levels: nearest Gaussians, and what a ray hits (Section 4.4 of the paper)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.projection import NEAR_PLANE, exact_centre, rotation_rows
from freqgs_plugin.types import Camera, Gaussians

_OPAQUE = 0.5
"""a ray ends where this much of it is absorbed"""
_LEAST_SIZE = 1e-12


@dataclass(frozen=True)
class Hit:
    """What a ray meets."""

    row: int
    """of the index's Gaussians, as numbered in the scene"""
    depth: float
    """camera z, world units"""
    point: Float[Tensor, " 3"]
    """in the world, on the ray"""


class GeometryIndex:
    """A k-d tree of the centres of levels <= `level`; rows are numbered as in `gaussians`.

    Raises:
        ValueError: no Gaussian is of these levels, or a centre is not finite.
    """

    def __init__(self, gaussians: Gaussians, level: int = 1) -> None:
        from scipy.spatial import KDTree

        self.rows: Int[Tensor, " m"] = torch.where(gaussians.level <= level)[0]
        if not len(self.rows):
            raise ValueError(f"level is {level}, and no Gaussian is of that level or under it; levels begin at 1.")
        self.gaussians = gaussians.select(self.rows)
        centres = self.gaussians.means.detach().double().cpu().numpy()
        if not np.isfinite(centres).all():
            count = int((~np.isfinite(centres)).any(1).sum())
            raise ValueError(f"{count} centres are not finite; remove these Gaussians before an index is made.")
        self._tree = KDTree(centres)

    def __len__(self) -> int:
        return len(self.rows)

    def nearest(self, points: Float[Tensor, "p 3"]) -> tuple[Float[Tensor, " p"], Int[Tensor, " p"]]:
        """Distance of each point to the nearest centre (world units), and that Gaussian's row.

        Raises:
            ValueError: a point is not finite.
        """
        asked = points.detach().double().cpu().numpy()
        if not np.isfinite(asked).all():
            raise ValueError("points hold NaN or infinity; they must be finite places in world units.")
        distance, found = self._tree.query(asked)
        rows = self.rows.cpu()[torch.from_numpy(np.asarray(found, np.int64))]
        return torch.from_numpy(np.asarray(distance)).to(points), rows.to(points.device)

    @torch.no_grad()
    def pick(self, camera: Camera, pixel: tuple[float, float]) -> Hit | None:
        """What the ray through `pixel` (x, y; centres at +0.5) meets first; None where it passes by everything.

        Along the ray, each Gaussian absorbs its opacity times exp(-d^2 / 2), d its least Mahalanobis distance to the
        ray; what is hit is the Gaussian at which half of the ray is absorbed, at the place where it is densest.
        """
        g = self.gaussians
        means, viewmat, intrinsics = (t.double() for t in (g.means, camera.viewmat.to(g.means), camera.K.to(g.means)))
        slope_x = (pixel[0] - intrinsics[0, 2]) / intrinsics[0, 0]
        slope_y = (pixel[1] - intrinsics[1, 2]) / intrinsics[1, 1]
        # camera z is 1 per unit of the ray, so that its parameter is the depth
        ray = torch.stack([slope_x, slope_y, torch.ones_like(slope_x)])
        centre = exact_centre(camera).to(means)
        # solved for, not turned back: a rotation rounded to float32 is not quite one
        direction = torch.linalg.solve(viewmat[:3, :3], ray)
        rotation = torch.stack([torch.stack(row, -1) for row in rotation_rows(g.quats.double())], -2)
        scales = g.scales.double().clamp_min(_LEAST_SIZE)
        # into each Gaussian's own axes, in standard deviations
        from_mean = torch.einsum("nij,ni->nj", rotation, centre - means) / scales
        along = torch.einsum("nij,i->nj", rotation, direction) / scales
        depth = -(from_mean * along).sum(-1) / along.square().sum(-1)
        squared = (from_mean + depth[:, None] * along).square().sum(-1)
        alpha = torch.where(depth > NEAR_PLANE, g.opacities.double() * torch.exp(-0.5 * squared), 0.0)
        order = torch.argsort(depth, stable=True)
        left = torch.cumprod(1 - alpha[order], 0)
        ended = torch.where(left <= 1 - _OPAQUE)[0]
        if not len(ended):
            return None
        row = order[ended[0]]
        return Hit(int(self.rows[row]), float(depth[row]), (centre + depth[row] * direction).to(g.means))
