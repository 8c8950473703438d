"""What keeps a scene small, and right from views that were never seen: penalties on opacity and size, and dropout.

The penalties are those of "3D Gaussian Splatting as Markov Chain Monte Carlo" (Eq. 9): a Gaussian that no picture needs
fades until it is pruned. Here each view's term is on the Gaussians that it shows: what no view shows is not judged.
Dropout is DropGaussian's: what a few views show is not left to single Gaussians in front.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def opacity_shown(opacities: Float[Tensor, " n"], shown: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    """Sum of the opacities of what is shown, divided by the number of all Gaussians; 0 without Gaussians."""
    return (opacities * shown).sum() / max(len(opacities), 1)


def size_shown(scales: Float[Tensor, "n 3"], shown: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    """Sum of the mean standard deviation over all axes, world units, divided and restricted likewise."""
    return (scales * shown[:, None]).sum() / max(scales.numel(), 1)


FEW_VIEWS = 25
"""under this many training views, dropout helped; with more it cost quality"""


def default_dropout(num_views: int) -> float:
    """Share to drop in training on so many views."""
    return 0.1 if num_views < FEW_VIEWS else 0.0


def drop_out(opacities: Float[Tensor, " n"], rate: float | int, seed: int, step: int) -> Float[Tensor, " n"]:
    """Opacities with a random share `rate` set to 0 and the others divided by 1 - rate: the mean stays.

    Which ones depends on seed, step and number of Gaussians alone, so a resumed run drops what the whole run would have
    dropped. Opacities above 1 come out as they are; rasterizers cap alpha.
    """
    kept = np.random.default_rng((seed, step)).random(len(opacities), np.float32) >= rate
    return opacities * torch.from_numpy(kept).to(opacities).div_(1.0 - rate)
