"""Quality of pictures against photographs, and how much a picture changes from frame to frame."""

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay
from freqgs_plugin.functional.image_loss import ssim
from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun, draw
from freqgs_plugin.reports.experiments.lab import LoadedRun
from freqgs_plugin.reports.experiments.options import ExperimentError
from freqgs_plugin.reports.tables import psnr

GREY_LEVELS = 255.0
AROUND = 5
"""changes on either side that say what is usual"""


@dataclass(frozen=True)
class Quality:
    """Means over views."""

    psnr: float
    """dB; pictures are clamped to [0, 1], as they would be shown"""
    ssim: float
    drawn: float
    """Gaussians passed to the rasterizer"""


def quality(
    run: TrainedRun, views: Sequence[HeldOutView], attenuation: Callable[[int], Attenuation | None] = lambda view: None
) -> Quality:
    """Draw every view with the attenuation for its number, and compare it with its photograph."""
    rows = []
    for number, view in enumerate(views):
        rendering = draw(run, view.camera, attenuation(number))
        picture = rendering.features.clamp(0, 1)
        target = view.image.to(picture)
        pair = (image.permute(2, 0, 1)[None] for image in (picture, target))
        rows.append((psnr(picture, target), float(ssim(*pair)), float(rendering.info["drawn"])))
    return Quality(*(statistics.fmean(column) for column in zip(*rows, strict=True)))


def at_scale(run: LoadedRun, scale: float | int) -> DistanceDecay:
    """The run as the viewer draws it at s_v = `scale`: divided by the scene's distance, cut softly.

    Raises:
        ExperimentError: its decays do not act.
    """
    if run.gaussians.decay is None or run.scene_distance is None:
        raise ExperimentError("the run ended before its opacities began to decay; train longer (--steps)")
    return DistanceDecay(scale, scene_distance=run.scene_distance)


@dataclass(frozen=True)
class Changes:
    """How neighbouring frames differ. Mean over pixels and colours of the absolute difference, grey levels of 255."""

    each: list[float]
    """from frame i to frame i + 1"""
    worst_pixel: float
    """the largest change of any colour of any pixel, grey levels of 255"""

    @property
    def largest(self) -> float:
        return max(self.each)

    @property
    def mean(self) -> float:
        return statistics.fmean(self.each)

    @property
    def median(self) -> float:
        return statistics.median(self.each)

    @property
    def sudden(self) -> float:
        """The largest excess of a change over the median of itself and the `AROUND` before and after, grey levels.

        What grows slowly, as motion does, is not in it.
        """
        medians = (statistics.median(self.each[max(i - AROUND, 0) : i + AROUND + 1]) for i in range(len(self.each)))
        return max(change - median for change, median in zip(self.each, medians, strict=True))

    @property
    def largest_by_median(self) -> float:
        """How much the largest change stands out; infinite where most frames do not change at all."""
        return self.largest / self.median if self.median > 0 else math.inf


def changes(pairs: Iterable[tuple[Float[Tensor, "h w c"], Float[Tensor, "h w c"]]]) -> Changes:
    """Of pairs of pictures before and after, clamped to [0, 1] as they would be shown.

    Raises:
        ValueError: no pairs.
    """
    each, worst = [], 0.0
    for before, after in pairs:
        difference = (after.clamp(0, 1) - before.clamp(0, 1)).abs() * GREY_LEVELS
        each.append(float(difference.mean()))
        worst = max(worst, float(difference.max()))
    if not each:
        raise ValueError("there are no frames to compare")
    return Changes(each, worst)


def neighbours(
    frames: Iterable[Float[Tensor, "h w c"]],
) -> Iterable[tuple[Float[Tensor, "h w c"], Float[Tensor, "h w c"]]]:
    """Each frame with the next one; only two are in memory."""
    before: Tensor | None = None
    for frame in frames:
        if before is not None:
            yield before, frame
        before = frame
