"""How far pictures are from photographs, what they take, and how often they leave [0, 1]."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.image_loss import ssim
from freqgs_plugin.functional.pyramid import reduce
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.report.drawn import Subset
from freqgs_plugin.reports.tables import psnr

Lpips = Callable[[Tensor, Tensor], Any]
"""of two batches of pictures in [0, 1]"""


@dataclass(frozen=True)
class Errors:
    """Means over views; pictures are clamped to [0, 1], as they would be shown."""

    psnr: float
    """dB"""
    ssim: float
    lpips: float | None
    """None: not computed"""

    @property
    def rmse(self) -> float:
        return rmse_of(self.psnr)

    def json(self) -> dict[str, float | None]:
        return {"psnr": self.psnr, "ssim": self.ssim, "lpips": self.lpips, "rmse": self.rmse, "1-ssim": 1 - self.ssim}


def rmse_of(psnr: float | int) -> float:
    """Root mean square error in units of full intensity; of a mean PSNR it is the geometric mean over views."""
    return 10 ** (-psnr / 20)


def measure_quality(subset: Subset, views: Sequence[HeldOutView], lpips: Lpips | None) -> dict[str, Any]:
    """Errors at full size and, of a prefix, at its own; Gaussians drawn; pixels outside of [0, 1]."""
    full, own, drawn, clamped = [], [], [], []
    for view in views:
        rendering = subset.draw(view.camera)
        picture = rendering.features.clamp(0, 1).permute(2, 0, 1)[None]
        target = view.image.to(picture).permute(2, 0, 1)[None]
        full.append(_errors(picture, target, lpips))
        if subset.halvings:
            own.append(_errors(reduce(picture, subset.halvings), reduce(target, subset.halvings), None))
        drawn.append(float(rendering.info["drawn"]))
        clamped.append(_outside(rendering.features))
    count = statistics.fmean(drawn)
    return {
        "label": subset.label,
        "value": subset.value,
        **_mean(full).json(),
        "own": _mean(own).json() if own else None,
        "drawn": count,
        "bytes": count * subset.of.bytes_each,
        "clamped": {
            "share": statistics.fmean(c[0] for c in clamped),
            "lowest": min(c[1] for c in clamped),
            "highest": max(c[2] for c in clamped),
            "non_finite": sum(c[3] for c in clamped),
        },
    }


def _errors(picture: Float[Tensor, "1 3 h w"], target: Float[Tensor, "1 3 h w"], lpips: Lpips | None) -> Errors:
    db = psnr(picture[0].permute(1, 2, 0), target[0].permute(1, 2, 0))
    return Errors(db, float(ssim(picture, target)), None if lpips is None else float(lpips(picture, target)))


def _mean(each: Sequence[Errors]) -> Errors:
    perceived = [e.lpips for e in each if e.lpips is not None]
    return Errors(
        statistics.fmean(e.psnr for e in each),
        statistics.fmean(e.ssim for e in each),
        statistics.fmean(perceived) if perceived else None,
    )


def _outside(picture: Float[Tensor, "h w 3"]) -> tuple[float, float, float, int]:
    """Share of pixels with a colour outside of [0, 1], the lowest and highest colour, pixels that are not finite."""
    finite = picture.isfinite().all(-1)
    outside = ((picture < 0) | (picture > 1)).any(-1) | ~finite
    kept = picture[finite]
    low, high = (float(kept.min()), float(kept.max())) if len(kept) else (float("nan"), float("nan"))
    return float(outside.float().mean()), low, high, int((~finite).sum())


def lpips_if_there(device: torch.device) -> Lpips | None:
    """LPIPS where its weights are on this machine."""
    from freqgs_plugin.reports.bench.trained import quiet

    with quiet():
        from freqgs_plugin.studio.lpips import lpips_if_available

        found = lpips_if_available(device)
    if found is None:
        return None

    def distance(picture: Tensor, target: Tensor) -> float:
        with torch.no_grad():
            return float(found(picture, target))

    return distance
