"""What each prefix of levels costs and how good it is: a table for the terminal and the same numbers as JSON."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import LevelCut
from freqgs_plugin.functional.pyramid import reduce
from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun, draw
from freqgs_plugin.reports.timing import Timing, environment, measure

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class PrefixRow:
    """One prefix of levels, averaged over the held-out views."""

    level: int
    gaussians: int
    """Gaussians drawn, of all views the most"""
    psnr_own: float
    """dB, against the photograph, both reduced to the prefix's size (REDUCE^(L - level))"""
    psnr_full: float
    """dB, against the photograph itself"""
    render: Timing
    """of the first view"""


def psnr(picture: Float[Tensor, "*pixels 3"], target: Float[Tensor, "*pixels 3"]) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal pictures."""
    error = float(torch.mean((picture - target) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def reduced_psnr(picture: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], times: int) -> float:
    """`psnr` after `times` halvings of both pictures."""
    pair = torch.stack([picture, target]).permute(0, 3, 1, 2)
    small = reduce(pair, times).permute(0, 2, 3, 1)
    return psnr(small[0], small[1])


def prefix_rows(run: TrainedRun, views: Sequence[HeldOutView], repeats: int = 9) -> list[PrefixRow]:
    """Measure every prefix 1..L on `views`. Pictures are clamped to [0, 1] as they would be shown.

    Raises:
        ValueError: no views.
    """
    if not views:
        raise ValueError("no held-out views to measure on; choose an evaluation split that holds some back")
    rows = []
    for level in range(1, run.num_levels + 1):
        cut, own, full, drawn = LevelCut(level), [], [], []
        for view in views:
            rendering = draw(run, view.camera, cut)
            picture = rendering.features.clamp(0, 1)
            target = view.image.to(picture)
            own.append(reduced_psnr(picture, target, run.num_levels - level))
            full.append(psnr(picture, target))
            drawn.append(int(rendering.info["drawn"]))
        timing = measure(lambda cut=cut: draw(run, views[0].camera, cut), repeats)
        rows.append(PrefixRow(level, max(drawn), sum(own) / len(own), sum(full) / len(full), timing))
    return rows


def prefix_table(rows: Sequence[PrefixRow], title: str = "Prefixes of levels, held-out views") -> "Table":
    """The rows for a terminal."""
    from rich.table import Table

    table = Table(title=title)
    for heading in ("levels", "Gaussians", "PSNR at own size", "PSNR at full size", "render, ms"):
        table.add_column(heading, justify="right")
    for row in rows:
        name = "1" if row.level == 1 else f"1-{row.level}"
        time = f"{row.render.median_ms:.1f} ({row.render.low_ms:.1f}-{row.render.high_ms:.1f})"
        table.add_row(name, f"{row.gaussians:,}", f"{row.psnr_own:.2f} dB", f"{row.psnr_full:.2f} dB", time)
    return table


def write_report(path: Path, rows: Sequence[PrefixRow], **more: Any) -> dict[str, Any]:
    """Write rows, environment and whatever else is given as JSON, and return it. Infinite numbers become null."""
    report = {**environment(), **more, "prefixes": [asdict(row) for row in rows]}
    text = json.dumps(finite_json(report), indent=2, default=str, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
    return report


def finite_json(value: Any) -> Any:
    """JSON has no infinity."""
    if isinstance(value, dict):
        return {key: finite_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
