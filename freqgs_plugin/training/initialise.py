"""Parameters at step 0, from seed points or at random."""

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from freqgs_plugin.functional.harmonics import C0, num_coefficients

INITIAL_OPACITY = 0.1
"""of every Gaussian, as in 3D Gaussian splatting"""
_NEIGHBOURS = 3
_LEAST_SPACING = 0.01
"""neighbour distances count as at least this share of their median: of duplicate points the logarithm would be -inf"""


def neighbour_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance to the three nearest other points, clamped from below; 1 for a single point."""
    if len(points) < 2:
        return torch.ones(len(points))
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=neighbours + 1)
    mean = torch.from_numpy(distances[:, 1:]).float().mean(-1)
    positive = mean[mean > 0]
    floor = _LEAST_SPACING * float(positive.median()) if len(positive) else 1.0
    return mean.clamp_min(floor)


def random_rotations(n: int, generator: torch.Generator) -> Float[Tensor, "n 4"]:
    """Unit quaternions, uniform over rotations."""
    return torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=-1)


def initial_parameters(
    points: Float[Tensor, "n 3"],
    colours: Float[Tensor, "n 3"],
    sh_degree: int,
    generator: torch.Generator,
) -> dict[str, torch.nn.Parameter]:
    """The six groups of splatfacto (log scales, logit opacities) for seed `points` (world) with `colours` in [0, 1].

    Raises:
        ValueError: no points, or points that are not finite.
    """
    n = len(points)
    if n == 0:
        raise ValueError("there are no seed points to start from; use random initialisation instead.")
    if not bool(torch.isfinite(points).all()):
        bad = int((~torch.isfinite(points)).any(-1).sum())
        raise ValueError(f"{bad} of {n} seed points are not finite; remove them from the scene's point cloud.")
    log_scale = neighbour_distance(points.float()).log()[:, None].repeat(1, 3)
    parameters = {
        "means": points.float().clone(),
        "scales": log_scale,
        "quats": random_rotations(n, generator),
        "features_dc": (colours.float() - 0.5) / C0,
        "features_rest": torch.zeros(n, num_coefficients(sh_degree) - 1, 3),
        "opacities": torch.full((n, 1), INITIAL_OPACITY).logit(),
    }
    return {name: torch.nn.Parameter(value) for name, value in parameters.items()}


def random_points(n: int, size: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """`n` points uniform in a cube of side `size` about the origin (world units), and their random colours."""
    return (torch.rand(n, 3, generator=generator) - 0.5) * size, torch.rand(n, 3, generator=generator)
