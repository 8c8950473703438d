"""What the claims are judged by: figures of one run, and of two or more runs side by side."""

import statistics
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch

from freqgs_plugin.functional.attenuation import LevelCut
from freqgs_plugin.reports.bench.foveation import foveation_rows
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.drawing import draw
from freqgs_plugin.reports.experiments.lab import LoadedRun
from freqgs_plugin.reports.experiments.measures import GREY_LEVELS, at_scale, quality
from freqgs_plugin.reports.tables import reduced_psnr
from freqgs_plugin.reports.timing import interleaved

ROUNDS = 9
FOVEATED_SIZE = (3840, 2160)
FOVEATED_ROUNDS = 3
INSIDE = 0.2
"""dB that may be lost inside of the fovea"""
KEPT = ("faster", "radius", "sigma", "times", "lost_inside", "lost_outside", "drawn")


def figures(run: LoadedRun) -> dict[str, Any]:
    """Of the whole picture, of each prefix at its own size, and of each level; means over the held-out views.

    `added` is the root mean square of what a level changes in the picture of those below it, grey levels of 255.
    `scales` are geometric means of the Gaussians' standard deviations, world units.
    """
    views, gaussians, levels = run.cameras("test"), run.gaussians, run.num_levels
    decays = gaussians.decay is not None and run.scene_distance is not None
    whole = quality(run, views, (lambda _: at_scale(run, 1.0)) if decays else (lambda _: None))
    prefixes: list[list[float]] = [[] for _ in range(levels)]
    added: list[list[float]] = [[] for _ in range(levels)]
    for view in views if levels > 1 else ():
        before = None
        for k in range(1, levels + 1):
            picture = draw(run, view.camera, LevelCut(k)).features
            target = view.image.to(picture)
            prefixes[k - 1].append(reduced_psnr(picture.clamp(0, 1), target, levels - k))
            change = picture - (run.background if before is None else before)
            added[k - 1].append(GREY_LEVELS * float(change.square().mean().sqrt()))
            before = picture
    rows = [gaussians.level == k for k in range(1, levels + 1)]
    return {
        "gaussians": len(gaussians),
        **asdict(whole),
        "counts": [int(row.sum()) for row in rows],
        "prefixes": [statistics.fmean(values) if values else None for values in prefixes],
        "added": [statistics.fmean(values) if values else None for values in added],
        "scales": [_mean_scale(gaussians.scales[row]) for row in rows],
    }


def _mean_scale(scales: torch.Tensor) -> float | None:
    return float(scales.detach().double().clamp_min(1e-12).log().mean().exp()) if len(scales) else None


def speeds(runs: Mapping[str, LoadedRun]) -> dict[str, Any]:
    """Milliseconds of the first held-out view, in turns, so that what else the machine does meets all alike."""
    camera = next(iter(runs.values())).cameras("test")[0].camera

    def picture(run: LoadedRun) -> Any:
        decays = run.gaussians.decay is not None and run.scene_distance is not None
        return draw(run, camera, at_scale(run, 1.0) if decays else None).features

    times = interleaved({name: lambda run=run: picture(run) for name, run in runs.items()}, ROUNDS)
    return {name: asdict(timing) for name, timing in times.items()}


def foveated(run: LoadedRun) -> dict[str, Any]:
    """The fastest settings that lose at most `INSIDE` dB within the fovea, at 3840x2160.

    `plain`: fewer Gaussians alone, as in the paper; `smaller`: fewer pixels outside of the fovea, too.
    """
    rows = foveation_rows(run, run.cameras("test")[0], *FOVEATED_SIZE, BenchOptions(rounds=FOVEATED_ROUNDS))
    allowed = [row for row in rows if row["radius"] is not None and row["lost_inside"] <= INSIDE]
    found: dict[str, Any] = {}
    groups = {"plain": [r for r in allowed if r["times"] == 1], "smaller": [r for r in allowed if r["times"] > 1]}
    for name, of in groups.items():
        best = max(of, key=lambda row: row["faster"], default=None)
        found[name] = None if best is None else {key: best[key] for key in KEPT}
    return found
