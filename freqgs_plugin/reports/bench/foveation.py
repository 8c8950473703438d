"""Foveation on a trained run, with and without fewer pixels: time against what is lost, by image size and width."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.rescaled import render_rescaled
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.drawing import TrainedRun, draw
from freqgs_plugin.reports.tables import psnr
from freqgs_plugin.types import Camera, Rendering

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZES = ((640, 480), (1920, 1080), (3840, 2160))
QUICK_SIZES = ((160, 120),)
GAZE = (0.5, 0.5)
FOVEA = 0.1
"""radius in which the loss counts as inside, share of the longer side"""
SETTINGS = (
    *((0.1, sigma, times) for times in (1, 2, 4) for sigma in (0.02, 0.05, 0.1, 0.2)),
    *((0.0, sigma, 1) for sigma in (0.05, 0.1, 0.2, 0.4)),
)
"""radius, sigma, and how many times smaller the picture outside of the fovea is; radius 0 is the paper's way"""
EVERYTHING = "everything"
PATIENCE = 60.0
"""for the rounds of one size, seconds"""


def foveation_rows(run: TrainedRun, view: Any, width: int, height: int, options: BenchOptions) -> list[Row]:
    """Every setting at one image size, all of them timed in the same rounds."""
    camera, photo = enlarged(view, width, height)
    look = {"rasterizer": run.rasterizer, "background": run.background, "antialiased": run.antialiased}

    def foveated(radius: float, sigma: float, times: int) -> Rendering:
        gaze = Foveation(GAZE, sigma, radius)
        if times == 1:
            return draw(run, camera, gaze)
        return render_rescaled(run.gaussians, camera, gaze, times=times, depth=False, **look)

    ways = {EVERYTHING: lambda: draw(run, camera), **{str(s): lambda s=s: foveated(*s) for s in SETTINGS}}
    timings = patient(ways, options.rounds, PATIENCE)
    full, fovea = draw(run, camera), _disc(width, height, FOVEA)
    rows = []
    for setting in (None, *SETTINGS):
        name = EVERYTHING if setting is None else str(setting)
        radius, sigma, times = (None, None, None) if setting is None else setting
        what = {"size": (width, height), "radius": radius, "sigma": sigma, "times": times, "time": timings[name]}
        faster = ratio(timings[EVERYTHING], timings[name])
        rows.append({**what, "faster": faster, **_quality(ways[name](), full, photo, fovea)})
    return rows


def _quality(rendering: Rendering, full: Rendering, photo: Tensor, fovea: Bool[Tensor, "h w"]) -> dict[str, Any]:
    picture, whole = rendering.features.clamp(0, 1), full.features.clamp(0, 1)

    def lost(where: Tensor) -> float:
        return psnr(whole[where][None], photo[where][None]) - psnr(picture[where][None], photo[where][None])

    return {
        "drawn": int(rendering.info["drawn"]),
        "lost_inside": lost(fovea),
        "lost_outside": lost(~fovea),
        "error_inside": float((picture - whole)[fovea].square().mean().sqrt()),
        "error_outside": float((picture - whole)[~fovea].square().mean().sqrt()),
    }


def enlarged(view: Any, width: int, height: int) -> tuple[Camera, Float[Tensor, "h w 3"]]:
    """The view's camera and photograph at another size: enlarged until it is covered, its middle cut out."""
    camera, image = view.camera, view.image
    factor = max(width / camera.width, height / camera.height)
    K = camera.K.clone()
    K[:2] *= factor
    K[0, 2] += (width - factor * camera.width) / 2
    K[1, 2] += (height - factor * camera.height) / 2
    sides = max(round(factor * camera.height), height), max(round(factor * camera.width), width)
    large = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], sides, mode="bicubic")[0].permute(1, 2, 0)
    top, left = (sides[0] - height) // 2, (sides[1] - width) // 2
    return Camera(camera.viewmat, K, width, height), large[top : top + height, left : left + width].clamp(0, 1)


def _disc(width: int, height: int, radius: float) -> Bool[Tensor, "h w"]:
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.hypot(x - GAZE[0] * width, y - GAZE[1] * height) <= radius * max(width, height)


def foveation_table(rows: Sequence[Row]) -> BenchTable:
    """Time against error, by image size."""
    return BenchTable(
        "foveation",
        "Foveation",
        rows,
        [
            ("image", lambda row: f"{row['size'][0]}x{row['size'][1]}"),
            ("radius", lambda row: EVERYTHING if row["radius"] is None else f"{row['radius']:g}"),
            ("sigma", lambda row: "" if row["sigma"] is None else f"{row['sigma']:g}"),
            ("times smaller", lambda row: "" if row["times"] is None else str(row["times"])),
            ("drawn", lambda row: f"{row['drawn']:,}"),
            ("ms", lambda row: milliseconds(row["time"])),
            ("times as fast", lambda row: number(row["faster"])),
            ("lost inside, dB", lambda row: f"{row['lost_inside']:.2f}"),
            ("lost outside, dB", lambda row: f"{row['lost_outside']:.2f}"),
            ("RMSE inside", lambda row: number(row["error_inside"])),
            ("RMSE outside", lambda row: number(row["error_outside"])),
        ],
        f"One held-out view, gaze in its middle. *Inside*: within {FOVEA:g} of the longer side. *Lost*: PSNR of the "
        "whole picture against the (enlarged) photograph, less that of the foveated one. *RMSE*: against the whole "
        "picture. *Times smaller*: the picture outside of the fovea is drawn so many times smaller, and enlarged. "
        "Radius 0 is the paper's way.",
    )


def foveation_figure(rows: Sequence[Row]) -> "Figure":
    """Time against error in the fovea, a panel per size, a line over sigma for each way."""
    from matplotlib.figure import Figure

    sizes = list(dict.fromkeys(row["size"] for row in rows))
    figure = Figure(figsize=(4.2 * len(sizes), 3.8), dpi=100, layout="constrained")
    for axes, size in zip(figure.subplots(1, len(sizes), squeeze=False)[0], sizes, strict=True):
        of_size = [row for row in rows if row["size"] == size]
        everything = next(row["time"].median_ms for row in of_size if row["radius"] is None)
        axes.axhline(everything, color="black", linestyle=":", label=EVERYTHING)
        for radius, times in dict.fromkeys((r["radius"], r["times"]) for r in of_size if r["radius"] is not None):
            line = [row for row in of_size if (row["radius"], row["times"]) == (radius, times)]
            x, y = [row["error_inside"] for row in line], [row["time"].median_ms for row in line]
            smaller = f", {times} times smaller" if times > 1 else ""
            axes.plot(x, y, marker="o", markersize=4, label=f"radius {radius:g}{smaller}")
            for row in line:
                axes.annotate(f"{row['sigma']:g}", (row["error_inside"], row["time"].median_ms), fontsize=6)
        axes.set(xscale="log", title=f"{size[0]}x{size[1]}", xlabel="RMSE in the fovea", ylabel="ms")
        axes.set_ylim(bottom=0)
    figure.axes[0].legend(fontsize=7)
    figure.suptitle("Foveation: time against error in the fovea, sigma at each point", fontsize=10)
    return figure
