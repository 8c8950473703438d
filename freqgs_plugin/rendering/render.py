"""From Gaussians, a camera and an attenuation to a picture: the only path there is."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.functional.harmonics import level_colours
from freqgs_plugin.rendering.base import PrefixRasterizer, Rasterizer, Statistics
from freqgs_plugin.types import Camera, Gaussians, Rendering, Splats


def shade(gaussians: Gaussians, camera: Camera, weight: Float[Tensor, " n"] | None = None) -> Splats:
    """Splats of one view: colours in the viewing direction, opacities times `weight`."""
    return Splats(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities if weight is None else gaussians.opacities * weight,
        features=level_colours(
            gaussians.features_dc,
            gaussians.features_rest,
            gaussians.means - camera.centre,
            gaussians.level,
            gaussians.signed_residuals,
        ),
    )


def render(
    gaussians: Gaussians,
    camera: Camera,
    attenuation: Attenuation | None = None,
    *,
    rasterizer: Rasterizer,
    background: Float[Tensor, " 3"] | None = None,
    antialiased: bool = True,
    depth: bool = True,
) -> Rendering:
    """The picture of `gaussians`, for viewing: rows of weight 0 are dropped before the rasterizer sees them.

    `info["drawn"]` counts the rows that were passed on, and `info` otherwise describes those rows only.
    """
    weight = None
    if attenuation is not None:
        weight = attenuation(gaussians, camera)
        rows = _where(weight > 0)
        if len(rows) < len(weight):
            gaussians, weight = gaussians.select(rows), weight[rows]
    splats = shade(gaussians, camera, weight)
    rendering = rasterizer(splats, camera, background=background, antialiased=antialiased, depth=depth)
    return Rendering(rendering.features, rendering.alpha, rendering.depth, {**rendering.info, "drawn": len(splats)})


def _where(mask: Bool[Tensor, " n"]) -> Int[Tensor, " m"]:
    """Indices of what is true; on the CPU by numpy, which takes a quarter of torch's time."""
    return torch.from_numpy(np.flatnonzero(mask.numpy())) if mask.device.type == "cpu" else torch.where(mask)[0]


def render_prefixes(
    gaussians: Gaussians,
    camera: Camera,
    num_levels: int,
    attenuation: Attenuation | None = None,
    *,
    rasterizer: Rasterizer,
    background: Float[Tensor, " 3"] | None = None,
    antialiased: bool = True,
    statistics: Statistics = "full",
) -> list[Rendering]:
    """The pictures of the prefixes 1..num_levels, for training: every row stays (Eq. 5).

    `attenuation` multiplies opacities. The last one's `info` describes all rows; see `PrefixRasterizer.prefixes` for
    what its `means2d` receives. Rows of weight 0 have radius 0 there: they count as not seen. `info["drawn"]` counts
    the others. Prefixes of levels without Gaussians are composited once, with the prefix before them.
    """
    options = {"background": background, "antialiased": antialiased}
    weight = None if attenuation is None else attenuation(gaussians, camera)
    renderings = _composite_prefixes(
        shade(gaussians, camera, weight), gaussians.level, num_levels, camera, rasterizer, statistics, options
    )
    means2d = renderings[-1].info["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    if weight is not None:
        renderings[-1] = _without_hidden(renderings[-1], weight > 0)
    return renderings


def _without_hidden(rendering: Rendering, shown: Bool[Tensor, " n"]) -> Rendering:
    info = rendering.info
    radii = torch.where(shown, info["radii"], 0)
    return replace(rendering, info={**info, "radii": radii, "drawn": int(shown.sum())})


def rendered_weight(
    gaussians: Gaussians,
    camera: Camera,
    num_levels: int,
    attenuation: Attenuation | None = None,
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
) -> Float[Tensor, " n"]:
    """How much of the picture each Gaussian makes up: its weight in front-to-back compositing, summed over pixels.

    Summed over all prefixes that it belongs to, too, so that the base is not judged by what covers it. Occlusion
    counts: the gradient of a picture of ones with respect to a feature of each Gaussian is just this sum.
    """
    probe = gaussians.means.new_zeros(len(gaussians), 1).requires_grad_()
    weight = 1.0 if attenuation is None else attenuation(gaussians, camera).detach()
    splats = Splats(
        gaussians.means.detach(),
        gaussians.quats.detach(),
        gaussians.scales.detach(),
        gaussians.opacities.detach() * weight,
        probe,
    )
    with torch.enable_grad():
        renderings = _composite_prefixes(
            splats, gaussians.level, num_levels, camera, rasterizer, "full", {"antialiased": antialiased}
        )
        torch.stack([r.features.sum() for r in renderings]).sum().backward()
    return probe.new_zeros(len(gaussians)) if probe.grad is None else probe.grad[:, 0]


def _composite_prefixes(
    splats: Splats,
    level: Int[Tensor, " n"],
    num_levels: int,
    camera: Camera,
    rasterizer: Rasterizer,
    statistics: Statistics,
    options: dict[str, Any],
) -> list[Rendering]:
    if num_levels == 1:
        return [rasterizer(splats, camera, depth=False, **options)]
    if statistics == "full":
        # with "own", a picture that stands for two prefixes would feed the statistics twice
        rank = _distinct_prefixes(level, num_levels)
        if rank[-1] < num_levels:
            among = level.new_tensor(rank)[level.long() - 1]
            distinct = _composite_prefixes(splats, among, rank[-1], camera, rasterizer, statistics, options)
            return [distinct[k - 1] for k in rank]
    if isinstance(rasterizer, PrefixRasterizer):
        return rasterizer.prefixes(splats, level, num_levels, camera, statistics=statistics, **options)
    renderings, rows_drawn = [], []
    for k in range(1, num_levels + 1):
        rows = torch.where(level <= k)[0]
        part = splats if k == num_levels else splats.select(rows)
        renderings.append(rasterizer(part, camera, depth=False, **options))
        rows_drawn.append(rows)
    if statistics == "own" and renderings[-1].info["means2d"].requires_grad:
        renderings[-1] = _with_own_statistics(renderings, rows_drawn, level)
    return renderings


def _distinct_prefixes(level: Int[Tensor, " n"], num_levels: int) -> list[int]:
    """For each prefix its number among the distinct ones, from 1: a level without Gaussians adds nothing.

    The first and the last prefix always count, whether or not their levels hold any. So do all where a level lies
    outside of 1..num_levels, which the rasterizer refuses.
    """
    counts = [0] * num_levels
    if len(level) and int(level.min()) >= 1:
        counts = torch.bincount(level, minlength=num_levels + 1)[1 : num_levels + 1].tolist()
    rank = []
    for k, count in enumerate(counts, start=1):
        new = count > 0 or k in (1, num_levels) or sum(counts) < len(level)
        rank.append((rank[-1] if rank else 0) + new)
    return rank


def _with_own_statistics(renderings: list[Rendering], rows_drawn: list[Tensor], level: Tensor) -> Rendering:
    """The last rendering with a `means2d` that collects, for each level, the gradients of that level's own prefix."""
    last = renderings[-1]
    means2d = last.info["means2d"].detach().clone().requires_grad_()
    means2d.grad = torch.zeros_like(means2d)
    means2d.absgrad = torch.zeros_like(means2d)
    for k, (rendering, rows) in enumerate(zip(renderings, rows_drawn, strict=True), start=1):
        source = rendering.info["means2d"]
        own = level[rows] == k

        def collect(grad: Tensor, source: Tensor = source, rows: Tensor = rows, own: Tensor = own) -> None:
            means2d.grad[0, rows[own]] = grad[0, own]  # pyright: ignore[reportOptionalSubscript]
            if hasattr(source, "absgrad"):
                means2d.absgrad[0, rows[own]] = source.absgrad[0, own]  # pyright: ignore

        source.register_hook(collect)
    return Rendering(last.features, last.alpha, last.depth, {**last.info, "means2d": means2d})
