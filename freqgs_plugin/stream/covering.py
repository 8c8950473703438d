"""The base's order: what closes holes comes first.

A Gaussian makes up w_i(p) of a pixel's alpha A(p) in the whole base's picture; of that, what was sent makes up
F(p) = sum over sent i of w_i(p). In every round those come next whose sum over pixels and views of
(1 - F(p) / A(p))^2 w_i(p) is largest: pixels that have nearly everything hardly count, those that lack much do. The
first round is by w alone. Covering by such sums is a submodular problem, for which taking the best next is near the
best there is (Nemhauser, Wolsey, Fisher 1978); rounds save time.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.stream.views import reduced
from freqgs_plugin.types import Camera, Gaussians, Splats

ROUNDS = 16
"""parts of the base that are chosen one after the other"""
REDUCTION = 2
"""pictures are this many times smaller: orders differ little, and take a quarter of the time"""
_LEAST_ALPHA = 1e-3


def covering_order(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    rasterizer: Rasterizer,
    antialiased: bool,
    attenuation: Attenuation | None = None,
) -> Int[Tensor, " n"]:
    """All rows (at least one), those that close most holes first.

    The time is that of `ROUNDS` small pictures per camera, about.
    """
    count = len(gaussians)
    sent = torch.zeros(count, dtype=torch.bool, device=gaussians.means.device)
    rounds: list[Tensor] = []
    views = [reduced(camera, REDUCTION) for camera in cameras]
    length = max(1, -(-count // ROUNDS))
    while not bool(sent.all()):
        gain = torch.zeros_like(gaussians.opacities)
        for camera in views:
            gain += _gain(gaussians, sent, camera, rasterizer, antialiased, attenuation)
        best = torch.argsort(torch.where(sent, -torch.inf, gain), descending=True, stable=True)
        rounds.append(best[: min(length, count - int(sent.sum()))])
        sent[rounds[-1]] = True
    return torch.cat(rounds)


def _gain(
    gaussians: Gaussians,
    sent: Bool[Tensor, " n"],
    camera: Camera,
    rasterizer: Rasterizer,
    antialiased: bool,
    attenuation: Attenuation | None,
) -> Float[Tensor, " n"]:
    """Each Gaussian's share of one view's pixels, which count by what they lack."""
    weight = 1.0 if attenuation is None else attenuation(gaussians, camera).detach()
    opacities = gaussians.opacities.detach() * weight
    probe = sent.to(opacities)[:, None].requires_grad_()
    splats = Splats(gaussians.means.detach(), gaussians.quats.detach(), gaussians.scales.detach(), opacities, probe)
    with torch.enable_grad():
        rendering = rasterizer(splats, camera, antialiased=antialiased, depth=False)
        alpha = rendering.alpha.detach().clamp_min(_LEAST_ALPHA)
        lacking = (1 - rendering.features.detach() / alpha).clamp(0, 1)
        (lacking.square() * rendering.features).sum().backward()
    return torch.zeros_like(opacities) if probe.grad is None else probe.grad[:, 0]
