"""How far a picture and its gradients are from the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Errors:
    """Of a picture, in units of colour, and of the gradients of a fixed functional of it."""

    largest: float
    rms: float
    psnr: float
    """dB for a peak of 1; infinite where nothing differs"""
    gradients: Mapping[str, float]
    """parameter -> norm of the difference over norm of the truth, over all Gaussians"""

    @property
    def worst_gradient(self) -> float:
        return max(self.gradients.values())


def errors(
    picture: Tensor, gradients: Mapping[str, Tensor], true_picture: Tensor, true_gradients: Mapping[str, Tensor]
) -> Errors:
    """Against a truth in float64, on any device; a gradient that is truly zero has error 0 or infinity."""
    difference = picture.cpu().double() - true_picture
    square = float(difference.square().mean())
    return Errors(
        largest=float(difference.abs().max()),
        rms=math.sqrt(square),
        psnr=-10 * math.log10(square) if square > 0 else math.inf,
        gradients={name: _relative(gradients[name].cpu().double(), true) for name, true in true_gradients.items()},
    )


def _relative(actual: Tensor, true: Tensor) -> float:
    difference, size = float((actual - true).norm()), float(true.norm())
    return 0.0 if difference == 0 else difference / size if size > 0 else math.inf
