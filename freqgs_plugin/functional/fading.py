"""Opacities that stay, in place of those that fall with distance: a plain 3DGS scene cannot fade."""

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import log_decay

_FAINTEST = -60.0
"""least ln(opacity) that is stored; viewers draw nothing under ln(1/255) = -5.5"""


def faded_logits(logits: Float[Tensor, " n"], decay: Float[Tensor, " n"], distance: float | int) -> Float[Tensor, " n"]:
    """Logits of the opacities as seen from one normalised `distance` (Eq. 2 of CLoD-GS), all finite."""
    faded = log_decay(torch.full_like(logits, float(distance)), decay, 1.0)
    log_opacity = torch.nn.functional.logsigmoid(logits) + faded
    # bounded, so that the logit is finite
    return -torch.expm1(-log_opacity.clamp(_FAINTEST, -1e-7)).log()
