"""Artistic filters: changes of Gaussians by level, the same from every view (Section 4.7 and supplement 1.8).

A filter is a function from `Gaussians` to `Gaussians`; FILTERS are the paper's. The paper names the constant colour and
the 0.2 of `xray`; other amounts are ours.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.functional.harmonics import C0
from freqgs_plugin.types import Gaussians

Filter = Callable[[Gaussians], Gaussians]

DARK_BLUE = (0.02, 0.03, 0.15)
BRIGHTER = 0.2
"""added to RGB (the paper, for `xray`)"""
JITTER = 0.5
"""`brush`: standard deviation of the shift of a centre, in the Gaussian's own standard deviations"""
SEED = 0


def recoloured(gaussians: Gaussians, rows: Bool[Tensor, " n"], shift: float) -> Gaussians:
    """RGB of `rows` plus `shift`, for every direction; of residuals, too."""
    step = torch.where(rows, shift / (C0 * _gain(gaussians)), 0.0)
    return replace(gaussians, features_dc=gaussians.features_dc + step[:, None])


def uniform(gaussians: Gaussians, rows: Bool[Tensor, " n"], colour: tuple[float, float, float]) -> Gaussians:
    """`rows` in one colour from every direction. Of residuals `colour` is the residual."""
    gain = _gain(gaussians)[:, None]
    wanted = gaussians.features_dc.new_tensor(colour)
    # colour = gain (C0 dc + 0.5) - (gain - 1), see `harmonics.level_colours`
    dc = ((wanted + gain - 1) / gain - 0.5) / C0
    return replace(
        gaussians,
        features_dc=torch.where(rows[:, None], dc, gaussians.features_dc),
        features_rest=torch.where(rows[:, None, None], 0.0, gaussians.features_rest),
    )


def xray(gaussians: Gaussians) -> Gaussians:
    """Levels 1 and 2 in one dark blue, RGB of higher levels plus 0.2: a glow of fine detail on a dark body."""
    high = gaussians.level > 2
    return recoloured(uniform(gaussians, ~high, DARK_BLUE), high, BRIGHTER)


def brush(gaussians: Gaussians) -> Gaussians:
    """Levels 2, 4 ... brighter, 3, 5 ... darker, and all of them shifted at random: strokes. The base stays."""
    level = gaussians.level
    above = level > 1
    painted = recoloured(gaussians, above & (level % 2 == 0), BRIGHTER)
    painted = recoloured(painted, above & (level % 2 == 1), -BRIGHTER)
    # drawn on the CPU: the same strokes on every device
    noise = torch.randn(len(gaussians), 3, generator=torch.Generator().manual_seed(SEED)).to(gaussians.means)
    size = gaussians.scales.amax(-1, keepdim=True)
    return replace(painted, means=painted.means + torch.where(above[:, None], JITTER * size * noise, 0.0))


def sharp(gaussians: Gaussians) -> Gaussians:
    """Level 2 removed, higher levels opaque, the finest darker: hard contours."""
    kept = gaussians.select(gaussians.level != 2)
    if not len(kept):
        return kept
    high = kept.level > 2
    opaque = replace(kept, opacities=torch.where(high, 1.0, kept.opacities))
    return recoloured(opaque, high & (kept.level == kept.level.max()), -BRIGHTER)


FILTERS: Mapping[str, Filter] = {"xray": xray, "brush": brush, "sharp": sharp}


def apply_filter(gaussians: Gaussians, name: str) -> Gaussians:
    """The filter called `name`.

    Raises:
        ValueError: there is none, or the scene has a single level, on which filters by level do nothing of use.
    """
    if name not in FILTERS:
        raise ValueError(f"filter is '{name}'; choose {', '.join(FILTERS)}.")
    if len(gaussians) and int(gaussians.level.max()) < 2:
        raise ValueError(
            f"filter '{name}' works by level, and these Gaussians have one level; train lapsplat with more."
        )
    return FILTERS[name](gaussians)


def _gain(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """2 for residuals (Eq. 4), 1 for colours (Eq. 3)."""
    signed = (gaussians.level > 1) & gaussians.signed_residuals
    return 1.0 + signed.to(gaussians.features_dc.dtype)
