"""The training objective of the Laplacian-pyramid method (Eqs. 6-13) for one view.

With m levels present, level k is compared after n = m - k halvings. Two terms act on its prefix render (all Gaussians
of level <= k, at the full size of the stage):

- frequency (k < m): DFT magnitudes of the prefix against those of the low-passed image, at full size (Eqs. 6-8);
- image (every k): L1 and SSIM between REDUCE^n of the prefix and REDUCE^n of the image (Eqs. 9-12).

The image term takes REDUCE^n of the image itself, as the paper's code does, and not of its low-passed copy (Eq. 10).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.image_loss import Clamp, prepare
from freqgs_plugin.functional.pyramid import low_pass, reduce
from freqgs_plugin.functional.spectrum import Size, fast_size, magnitude
from freqgs_plugin.functional.terms import Terms, prefix_terms


@dataclass(frozen=True)
class PyramidTargets:
    """What one view's image contributes to the objective: constant, so worth keeping per view while m stays."""

    reduced: tuple[Float[Tensor, "1 3 _ _"], ...]
    """REDUCE^(m-k) of the masked image for levels k = 1..m, coarse to fine"""
    magnitudes: Float[Tensor, "levels 3 h w2"] | None
    """DFT magnitudes of the low-passed image for levels k = 1..m-1; None without the frequency term or if m = 1"""
    dft_size: Size | None = None
    """size of these transforms; None: the image's"""

    @classmethod
    def from_image(
        cls,
        image: Float[Tensor, "h w 3"],
        m: int,
        mask: Float[Tensor, "h w 1"] | None = None,
        *,
        dft: bool = True,
        dft_size: Literal["image", "fast"] = "image",
    ) -> "PyramidTargets":
        """The targets for m levels; `dft=False` leaves the magnitudes (of about the image's size per level) out.

        `dft_size`: the transforms' size is the image's (Eq. 7) or the next `fast_size`, with zeros beyond the image.
        """
        full = _planes(image, mask)
        reduced = [full]
        for _ in range(m - 1):
            reduced.append(reduce(reduced[-1]))
        low = [low_pass(full, m - k) for k in range(1, m)] if dft else []
        size = fast_size(*full.shape[-2:]) if dft_size == "fast" else None
        return cls(tuple(reversed(reduced)), magnitude(torch.cat(low), size) if low else None, size)


def default_level_weights(m: int) -> list[float]:
    """The paper's lambda_k of Eq. 12: 0.1 for k < m and 1 for k = m."""
    return [0.1] * (m - 1) + [1.0]


def pyramid_objective(
    prefixes: list[Float[Tensor, "h w 3"]],
    image: Float[Tensor, "h w 3"],
    *,
    level_weights: Sequence[float] | None = None,
    ssim_weight: float = 0.2,
    dft_weight: float = 1e-3,
    image_weight: float = 1.0,
    clamp_mode: Clamp = "none",
    dft: bool = True,
    dft_norm: Literal["backward", "ortho"] = "backward",
    lower_image_terms: bool = True,
    mask: Float[Tensor, "h w 1"] | None = None,
    targets: PyramidTargets | None = None,
) -> dict[str, Float[Tensor, ""]]:
    """Scalars `image_1` .. `image_m` and `dft`, already weighted: their sum is the total of Eq. 13.

    `prefixes[k - 1]` is the render of levels 1..k, not clamped. `level_weights` are lambda_k (default: the paper's).
    A term of weight 0 is neither computed nor returned. `mask` (1 = counts) multiplies image and prefixes before
    everything else, as in splatfacto. `targets` saves recomputing `PyramidTargets.from_image(image, m, mask)`.
    """
    m = len(prefixes)
    weights = default_level_weights(m) if level_weights is None else list(level_weights)
    if len(weights) != m:
        raise ValueError(f"{m} prefix renders need {m} level weights, got {len(weights)}. Pass one per level, or None.")
    use_dft = dft and dft_weight != 0 and m > 1
    if targets is None:
        targets = PyramidTargets.from_image(image, m, mask, dft=use_dft)
    if len(targets.reduced) != m:
        raise ValueError(f"targets are for {len(targets.reduced)} levels, but {m} are rendered. Make them anew.")

    if use_dft and targets.magnitudes is None:
        raise ValueError("targets lack DFT magnitudes. Make them with `dft=True`, or call with `dft=False`.")

    renders = [_planes(prepare(prefix, clamp_mode), mask) for prefix in prefixes]
    kept = [k == m or lower_image_terms for k in range(1, m + 1)]
    terms = Terms(
        reduced=targets.reduced,
        image_weights=[image_weight * weight if keep else 0.0 for weight, keep in zip(weights, kept, strict=True)],
        ssim_weight=ssim_weight,
        magnitudes=targets.magnitudes if use_dft else None,
        dft_size=targets.dft_size or (renders[0].shape[-2], renders[0].shape[-1]),
        # the mean over the stacked levels, times their number, is the sum of Eq. 8
        dft_weight=dft_weight * (m - 1),
        dft_norm=dft_norm,
    )
    names = [f"image_{k}" for k in range(1, m + 1)] + ["dft"]
    values = prefix_terms(terms, renders)
    return {name: value for name, value in zip(names, values, strict=True) if value is not None}


def _planes(image: Tensor, mask: Tensor | None) -> Tensor:
    """`[h w 3]`, masked, as `[1 3 h w]`."""
    return (image if mask is None else image * mask).permute(2, 0, 1)[None].contiguous()
