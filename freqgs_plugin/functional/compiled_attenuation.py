"""`DistanceDecay` for viewing, on the CPU in float32: the same as in `attenuation`, compiled.

Used because a picture that draws few Gaussians still looks at all of them, and most are known to have faded before a
logarithm or an exponential is taken. Squares are taken in float64, in which none of float32 overflows.
"""

import math

import numpy as np
import torch
from torch import Tensor

from freqgs_plugin.functional.numba_threads import njit


@njit(error_model="numpy", nogil=True, cache=True)
def _exponents(means, centre, decay, factor, farthest, largest, epsilon, faded, out):
    """Minus the exponent of Eq. 2; apart from what follows, so that it is done in vectors."""
    cx, cy, cz = centre[0], centre[1], centre[2]
    for i in range(len(out)):
        x, y, z = means[i, 0] - cx, means[i, 1] - cy, means[i, 2] - cz
        sigma = min(max(np.float64(decay[i]), 0.0), largest)
        square = min((x * x + y * y + z * z) * factor, farthest)
        out[i] = min(square / (2.0 * sigma * sigma + epsilon), faded)


@njit(error_model="numpy", nogil=True, cache=True)
def _weights(opacities, least, cut, faintest, soft, out):
    """`out`: minus the exponents, which become weights; `least`: the opacity that fainter ones count as."""
    one, two, three, doubled = np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(math.log(2.0))
    for i in range(len(out)):
        q = out[i]
        # no opacity is above 1, so its logarithm is not above 0
        if q >= -cut and opacities[i] <= one:
            out[i] = 0.0
            continue
        margin = math.log(max(opacities[i], least)) - q - cut
        if not margin > 0:
            out[i] = 0.0
            continue
        out[i] = math.exp(max(-q, faintest))
        if soft and margin < doubled:
            fade = min(math.exp(margin) - one, one)
            out[i] *= fade * fade * (three - two * fade)


def weights(
    means: Tensor,
    centre: Tensor,
    opacities: Tensor,
    decay: Tensor,
    scale: float,
    scene_distance: float,
    soft: bool,
) -> Tensor:
    """Weights [n] of float32 tensors on the CPU, without gradient; `centre` [3] is float64.

    The limits are those of `attenuation`.
    """
    from freqgs_plugin.functional.attenuation import (
        EPSILON,
        FADED,
        FAINTEST,
        FARTHEST,
        LARGEST_DECAY,
        LEAST_OPACITY,
        TAU,
    )

    out = torch.empty(len(means))
    ratio, line = min(scale, FARTHEST) / scene_distance, out.numpy()
    bounds = (FARTHEST**2, LARGEST_DECAY, EPSILON, FADED**2)
    _exponents(means.detach().numpy(), centre.detach().numpy(), decay.detach().numpy(), ratio * ratio, *bounds, line)
    limits = (np.float32(x) for x in (LEAST_OPACITY, math.log(TAU * scale), FAINTEST))
    _weights(opacities.detach().numpy(), *limits, soft, line)
    return out
