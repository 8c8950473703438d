"""One picture that shows what the levels of a run hold, view by view. Pixels are shown as they are, never resampled."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun, band, levels_picture, prefix

Picture = Float[np.ndarray, "_ _ 3"]

DPI = 100
GAP = 4
"""between pictures, pixels"""
LABEL = 22
"""height of the line above each picture, pixels"""


def view_pictures(run: TrainedRun, view: HeldOutView) -> list[tuple[str, Picture]]:
    """Labelled pictures of one view: photo, prefixes, bands above the base around mid-grey, colour by level."""
    last = run.num_levels

    def shown(image: torch.Tensor) -> Picture:
        return image.clamp(0, 1).float().cpu().numpy()

    pictures = [("photo", shown(view.image))]
    for level in range(1, last + 1):
        name = "level 1" if level == 1 else f"levels 1-{level}"
        pictures.append((name, shown(prefix(run, view.camera, level))))
    for level in range(2, last + 1):
        pictures.append((f"added by level {level}", shown(0.5 + band(run, view.camera, level))))
    pictures.append(("colour by level", shown(levels_picture(run, view.camera))))
    return pictures


def contact_sheet(path: Path, run: TrainedRun, views: Sequence[HeldOutView]) -> None:
    """Write the sheet of `views` as PNG, one row each.

    Raises:
        ValueError: no views.
    """
    if not views:
        raise ValueError("no held-out views for a contact sheet; choose an evaluation split that holds some back")
    write_sheet(path, [(Path(view.name).stem, view_pictures(run, view)) for view in views])


def write_sheet(path: Path, rows: Sequence[tuple[str, Sequence[tuple[str, Picture]]]]) -> None:
    """Write rows of labelled pictures as PNG. The row's own name stands in front of its first label."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    widths = [sum(picture.shape[1] + GAP for _, picture in row) + GAP for _, row in rows]
    heights = [max(picture.shape[0] for _, picture in row) + LABEL + GAP for _, row in rows]
    width, height = max(widths), sum(heights)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    top = 0
    for (name, row), row_height in zip(rows, heights, strict=True):
        left = GAP
        for i, (label, picture) in enumerate(row):
            h, w = picture.shape[:2]
            text = f"{name}: {label}" if i == 0 else label
            figure.text(left / width, 1 - (top + LABEL - 6) / height, text, fontsize=8.5, va="baseline")
            # figimage places whole pixels, counted from the lower left corner
            figure.figimage(_as_bytes(picture), left, height - top - LABEL - h, origin="upper")
            left += w + GAP
        top += row_height
    figure.savefig(path, dpi=DPI)


def _as_bytes(picture: Picture) -> np.ndarray:
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
