"""Harmonics of a lower degree that look the same from where the training views look.

A Gaussian is seen from few directions. Over these, harmonics of a higher degree are largely a constant, or what lower
ones can take over: what is left out is first fitted by what is kept, by least squares, each view weighted with how much
of it the Gaussian makes up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.functional.harmonics import basis
from freqgs_plugin.types import Camera, Gaussians

_CHUNK = 16_384
"""Gaussians at a time: 16 by 16 numbers each"""
_RIDGE = 0.01
"""added to the diagonal, as a share of its mean on a sphere: directions that no view looks from keep small colours"""
_MEAN_SQUARE = 0.0796
"""of a basis function over the sphere, 1 / 4 pi"""


@dataclass(frozen=True)
class HarmonicFits:
    """For each degree below the scene's: the best coefficients of each Gaussian, and what they miss."""

    coefficients: list[Float[Tensor, "n _ 3"]]
    """by degree 0.., [n, (degree + 1)^2, 3]"""
    errors: Float[Tensor, "degrees n"]
    """squared colour error, times pixels, over all views; of the scene's own degree 0"""

    @property
    def degree(self) -> int:
        """The scene's."""
        return len(self.coefficients)

    def degrees_at(self, price: float) -> Int[Tensor, " n"]:
        """The degree of least error plus `price` per coefficient."""
        degrees = torch.arange(self.degree + 1, device=self.errors.device)
        cost = (degrees + 1).square() * price
        return (self.errors + cost[:, None].to(self.errors)).argmin(0)

    def prices(self) -> tuple[float, float]:
        """A price at which next to nothing is left out, and one at which everything is."""
        positive = self.errors[self.errors > 0]
        if not len(positive):
            return 1e-12, 1.0
        return max(float(positive.min()) / 32, 1e-30), float(positive.max()) * 2

    def apply(self, gaussians: Gaussians, degrees: Int[Tensor, " n"]) -> Gaussians:
        """The Gaussians with harmonics up to `degrees`, none above the largest of them."""
        dc, rest = gaussians.features_dc.clone(), gaussians.features_rest.clone()
        for d, fitted in enumerate(self.coefficients):
            rows = torch.where(degrees == d)[0]
            dc[rows] = fitted[rows, 0]
            rest[rows] = 0.0
            rest[rows, : (d + 1) ** 2 - 1] = fitted[rows, 1:]
        top = int(degrees.max()) if len(degrees) else 0
        return replace(gaussians, features_dc=dc, features_rest=rest[:, : (top + 1) ** 2 - 1].contiguous())

    def select(self, rows: Tensor) -> "HarmonicFits":
        """Of the Gaussians in `rows`."""
        return HarmonicFits([c[rows] for c in self.coefficients], self.errors[:, rows])


@torch.no_grad()
def fit_harmonics(
    gaussians: Gaussians, cameras: Sequence[Camera], weights: Sequence[Float[Tensor, " n"]]
) -> HarmonicFits:
    """Fit every lower degree; `weights` are each view's `rendered_weight`, pixels."""
    degree = round((gaussians.features_rest.shape[1] + 1) ** 0.5) - 1
    chunks = [
        _fit_chunk(gaussians, slice(at, at + _CHUNK), cameras, weights, degree)
        for at in range(0, max(len(gaussians), 1), _CHUNK)
    ]
    coefficients = [torch.cat([c.coefficients[d] for c in chunks]) for d in range(degree)]
    errors = torch.cat([c.errors for c in chunks], 1)
    if gaussians.signed_residuals:
        # their colours are twice the harmonics
        errors = torch.where(gaussians.level > 1, 4 * errors, errors)
    return HarmonicFits(coefficients, errors)


def _fit_chunk(
    gaussians: Gaussians, rows: slice, cameras: Sequence[Camera], weights: Sequence[Tensor], degree: int
) -> HarmonicFits:
    means = gaussians.means[rows]
    all_of = torch.cat([gaussians.features_dc[rows, None], gaussians.features_rest[rows]], 1)
    products = means.new_zeros(len(means), all_of.shape[1], all_of.shape[1])
    total = means.new_zeros(len(means))
    for camera, weight in zip(cameras, weights, strict=True):
        directions = torch.nn.functional.normalize(means - camera.centre.to(means), dim=-1)
        values, share = basis(directions, degree), weight[rows].to(means)
        products.baddbmm_((values * share[:, None])[:, :, None], values[:, None])
        total += share
    coefficients, errors = [], []
    # unseen Gaussians have no products at all
    ridge = (_RIDGE * _MEAN_SQUARE * total).clamp_min(1e-12)
    for d in range(degree):
        kept = (d + 1) ** 2
        lower, upper = all_of[:, :kept], all_of[:, kept:]
        within, across = products[:, :kept, :kept], products[:, :kept, kept:]
        wanted = across @ upper
        damped = within + torch.diag_embed(ridge[:, None].expand(-1, kept))
        change = torch.linalg.solve(damped, wanted)
        missed = (upper * (products[:, kept:, kept:] @ upper)).sum((1, 2))
        missed += (change * (within @ change - 2 * wanted)).sum((1, 2))
        coefficients.append(lower + change)
        errors.append(missed.clamp_min(0.0))
    errors.append(torch.zeros_like(total))
    return HarmonicFits(coefficients, torch.stack(errors))
