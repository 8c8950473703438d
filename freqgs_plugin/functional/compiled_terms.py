"""All terms of the pyramid objective on the CPU, with one gradient: `terms` is the interface.

Each term by itself is a function with a gradient already (`compiled_image_loss`, `compiled_pyramid`,
`compiled_spectrum`). Here they write into one array for all prefixes, so that nothing is added up or copied afterwards.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freqgs_plugin.functional.compiled_image_loss import image_sums
from freqgs_plugin.functional.compiled_pyramid import add_halving_gradient, halve
from freqgs_plugin.functional.compiled_spectrum import distance, planes_of
from freqgs_plugin.functional.image_loss import window, windows
from freqgs_plugin.functional.terms import Terms


def compiled_terms(terms: Terms, renders: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The image terms of prefixes 1..m and the frequency term; 0 for those left out.

    The gradients of all prefixes lie in one array, one behind the other. They are made for terms that are added up as
    they are, and anew for any other use.
    """
    return CompiledTerms.apply(terms, *renders)  # pyright: ignore[reportReturnType]


class CompiledTerms(torch.autograd.Function):
    """(terms, *renders [1 3 h w]) -> m + 1 numbers; see `compiled_terms`."""

    @staticmethod
    def forward(ctx, terms: Terms, *renders: Tensor):
        wanted = any(ctx.needs_input_grad[1:])
        values, gradient = _evaluate(terms, renders, wanted)
        ctx.terms = terms
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(gradient, *renders)
        return tuple(renders[0].new_tensor(value) for value in values)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        terms: Terms = ctx.terms
        gradient, *renders = ctx.saved_tensors
        factors = [0.0 if v is None else float(v) for v in upstream]
        used = {factor for factor, weight in zip(factors, terms.weights, strict=True) if weight != 0}
        if len(used) > 1:
            image_weights = [w * f for w, f in zip(terms.image_weights, factors[:-1], strict=True)]
            scaled = replace(terms, image_weights=image_weights, dft_weight=terms.dft_weight * factors[-1])
            gradient = _evaluate(scaled, renders, True)[1]
        elif used and used != {1.0}:
            gradient = gradient * used.pop()
        return None, *gradient.unbind(0)


def _evaluate(terms: Terms, renders: Sequence[Tensor], wanted: bool) -> tuple[list[float], Tensor]:
    """The terms' values, and the gradient of their sum for all prefixes, [m 1 3 h w] (no elements if not wanted)."""
    m = len(renders)
    planes = [render.detach().contiguous() for render in renders]
    gradient = renders[0].new_empty(m if wanted else 0, *renders[0].shape)
    values = [0.0] * (m + 1)
    begun = 0
    if terms.magnitudes is not None:
        begun = m - 1
        height, width = terms.dft_size
        scale = (height * width) ** -0.5 if terms.dft_norm == "ortho" else 1.0
        lower, parts = planes_of(planes[:begun]), planes_of(list(gradient[:begun]))
        values[m] = distance(lower, terms.magnitudes, terms.dft_size, terms.dft_weight * scale, parts)
    for k, weight in enumerate(terms.image_weights):
        own, n = gradient[k : k + 1], m - 1 - k
        if wanted and k >= begun and (n > 0 or weight == 0):
            own.zero_()
        if weight == 0:
            continue
        sizes = [planes[k]]
        for _ in range(n):
            sizes.append(halve(sizes[-1]))
        slope = torch.empty_like(sizes[-1]) if n > 0 and wanted else own
        values[k] = _image_term(sizes[-1], terms.reduced[k], terms.ssim_weight, weight, slope)
        if wanted:
            for image in reversed(sizes[1:-1]):
                larger = torch.zeros_like(image)
                add_halving_gradient(slope, larger)
                slope = larger
            if n > 0:
                add_halving_gradient(slope, own[0])
    return values, gradient


def _image_term(x: Tensor, y: Tensor, ssim_weight: float, weight: float, gradient: Tensor) -> float:
    """`image_distance` of images [1 c h w], and its gradient for x into `gradient` unless that is empty."""
    height, width = x.shape[-2:]
    by_l1, by_ssim = weight * (1 - ssim_weight) / x.numel(), -weight * ssim_weight / windows(x)
    taps = window(height), window(width)
    pair = x.flatten(0, 1), y.detach().flatten(0, 1).contiguous()
    out = gradient.view(-1, height, width)
    return weight * ssim_weight + image_sums(*pair, *taps, height * width, by_ssim, by_l1, out)
