"""The terms of the pyramid objective (Eqs. 8 and 12) for renders and targets that are ready, and their weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.image_loss import TAPS, image_distance
from freqgs_plugin.functional.pyramid import reduce
from freqgs_plugin.functional.spectrum import Size, magnitude_distance_to


@dataclass(frozen=True)
class Terms:
    """What prefixes 1..m are compared with, and how."""

    reduced: Sequence[Float[Tensor, "1 3 _ _"]]
    """REDUCE^(m-k) of the image, k = 1..m"""
    image_weights: Sequence[float]
    """of the m image terms; 0 leaves one out"""
    ssim_weight: float
    magnitudes: Float[Tensor, "levels 3 u v2"] | None
    """DFT magnitudes for prefixes 1..m-1; None: no frequency term"""
    dft_size: Size
    """(u, v)"""
    dft_weight: float
    """times the mean over all bins of all these prefixes"""
    dft_norm: Literal["backward", "ortho"]

    @property
    def weights(self) -> list[float]:
        """Of all terms, the frequency term last."""
        return [*self.image_weights, 0.0 if self.magnitudes is None else self.dft_weight]


def prefix_terms(terms: Terms, renders: Sequence[Float[Tensor, "1 3 h w"]]) -> list[Float[Tensor, ""] | None]:
    """The image terms of prefixes 1..m and the frequency term, each with its weight; None for those left out.

    On the CPU compiled loops make the gradient of all of them at once.
    """
    if not _has_kernels(terms, renders):
        return terms_one_by_one(terms, renders)
    from freqgs_plugin.functional.compiled_terms import compiled_terms

    values = compiled_terms(terms, renders)
    return [value if weight != 0 else None for value, weight in zip(values, terms.weights, strict=True)]


def terms_one_by_one(terms: Terms, renders: Sequence[Float[Tensor, "1 3 h w"]]) -> list[Float[Tensor, ""] | None]:
    """`prefix_terms` on any device, in any dtype and size."""
    m = len(renders)
    values: list[Tensor | None] = []
    for k, weight in enumerate(terms.image_weights):
        reduced = None if weight == 0 else reduce(renders[k], m - 1 - k)
        value = None if reduced is None else image_distance(reduced, terms.reduced[k], terms.ssim_weight, weight)
        values.append(value)
    if terms.magnitudes is None:
        return [*values, None]
    arguments = terms.magnitudes, terms.dft_norm, terms.dft_size, terms.dft_weight
    return [*values, magnitude_distance_to(renders[:-1], *arguments)]


def _has_kernels(terms: Terms, renders: Sequence[Tensor]) -> bool:
    """On the CPU, in one precision of 32 or 64 bits, with sides of 11 px or more, and with targets that fit."""
    height, width = renders[0].shape[-2:]
    if terms.ssim_weight == 0 or renders[0].dtype not in (torch.float32, torch.float64):
        return False
    expected = []
    for _ in renders:
        expected.insert(0, (1, 3, height, width))
        height, width = (height + 1) // 2, (width + 1) // 2
    targets = list(terms.reduced)
    if terms.magnitudes is not None:
        expected.append((len(renders) - 1, 3, terms.dft_size[0], terms.dft_size[1] // 2 + 1))
        targets.append(terms.magnitudes)
    return (
        [tuple(target.shape) for target in targets] == expected
        and all(render.shape == renders[0].shape for render in renders)
        and min(terms.reduced[0].shape[-2:]) >= TAPS
        and all(t.device.type == "cpu" and t.dtype == renders[0].dtype for t in (*renders, *targets))
        and not any(target.requires_grad for target in targets)
    )
