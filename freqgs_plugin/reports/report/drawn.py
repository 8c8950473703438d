"""What is drawn of a run: its prefixes, a sweep of s_v, or cuts of a model of one level."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, LevelCut
from freqgs_plugin.rendering.render import render, rendered_weight
from freqgs_plugin.reports.bench.trained import views_of_split
from freqgs_plugin.reports.experiments.measures import at_scale
from freqgs_plugin.reports.report.options import ReportOptions
from freqgs_plugin.reports.report.runs import ReportedRun
from freqgs_plugin.types import Camera, Gaussians, Rendering

OPAQUE, SHOWN = "most opaque", "show most"


@dataclass(frozen=True)
class Subset:
    """One point of a report: a part of a run's Gaussians, and how they are drawn."""

    of: ReportedRun
    series: str
    """how subsets are chosen; empty where there is one way"""
    label: str
    value: float | int
    """level, s_v or share"""
    gaussians: Gaussians
    attenuation: Attenuation | None = None
    halvings: int = 0
    """of the picture at the subset's own size"""

    @torch.no_grad()
    def draw(self, camera: Camera) -> Rendering:
        """The picture, not clamped; `info["drawn"]` counts the Gaussians passed to the rasterizer."""
        run = self.of.run
        return render(
            self.gaussians,
            camera,
            self.attenuation,
            rasterizer=run.rasterizer,
            background=run.background,
            antialiased=run.antialiased,
            depth=False,
        )


def subsets(of: ReportedRun, options: ReportOptions, tick: Callable[[], object] = lambda: None) -> list[Subset]:
    """The points of a run; `tick` is called for each training view that is looked at."""
    run = of.run
    if of.kind == "prefixes":
        last = run.num_levels
        return [
            Subset(of, "", "1" if k == 1 else f"1-{k}", k, run.gaussians, LevelCut(k), last - k)
            for k in range(1, last + 1)
        ]
    if of.kind == "scales":
        scales = sorted(set(options.scales))
        return [Subset(of, "", f"s_v {s:g}", s, run.gaussians, at_scale(run, s)) for s in scales]
    shares = sorted(set(options.shares), reverse=True)
    return [*_cuts(of, OPAQUE, run.gaussians.opacities, shares), *_cuts(of, SHOWN, shown_weight(run, tick), shares)]


def full_detail(of: ReportedRun) -> Subset:
    """The run as ns-eval draws it."""
    run = of.run
    decay = at_scale(run, 1.0) if of.kind == "scales" else None
    return Subset(of, "", "full detail", 1.0, run.gaussians, decay)


def _cuts(of: ReportedRun, series: str, score: Float[Tensor, " n"], shares: Sequence[float]) -> list[Subset]:
    """The rows with the highest score: cut once, as a smaller model would be stored, and drawn as they are."""
    # in order of the score every cut is a slice, and all of them take the memory of one
    ordered = of.run.gaussians.select(torch.sort(score, descending=True, stable=True).indices)
    counts = [max(round(share * len(ordered)), 1) for share in shares]
    return [
        Subset(of, series, f"{100 * share:g} %", share, _first(ordered, count))
        for share, count in zip(shares, counts, strict=True)
    ]


def _first(g: Gaussians, count: int) -> Gaussians:
    return replace(
        g,
        means=g.means[:count],
        quats=g.quats[:count],
        scales=g.scales[:count],
        opacities=g.opacities[:count],
        features_dc=g.features_dc[:count],
        features_rest=g.features_rest[:count],
        level=g.level[:count],
        decay=None if g.decay is None else g.decay[:count],
    )


def shown_weight(run: Any, tick: Callable[[], object] = lambda: None) -> Float[Tensor, " n"]:
    """How much of all training views each Gaussian makes up, pixels; what lies behind others counts less."""
    total = torch.zeros_like(run.gaussians.opacities)
    for view in views_of_split(run, "train"):
        total += rendered_weight(run.gaussians, view.camera, 1, rasterizer=run.rasterizer, antialiased=run.antialiased)
        tick()
    return total
