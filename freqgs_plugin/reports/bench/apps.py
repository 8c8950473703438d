"""`freqgs bench apps`: what foveation and an index of the base gain on a trained run, what they lose, and filters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.apps.filters import FILTERS
from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.geometry import GeometryIndex
from freqgs_plugin.apps.own_filters import find_filter
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.drawing import draw
from freqgs_plugin.reports.filters import STEP, FilterRow, draw_filters, spread
from freqgs_plugin.reports.tables import psnr
from freqgs_plugin.reports.timing import Timing, measure
from freqgs_plugin.types import Camera, Gaussians

SIZES = ((640, 480), (1920, 1080), (3840, 2160))
QUICK_SIZES = ((160, 120),)
GAZE = (0.5, 0.5)
FOVEA = 0.1
"""radius in which the loss counts as inside, share of the longer side"""
SETTINGS = ((0.1, 0.02), (0.1, 0.05), (0.1, 0.1), (0.1, 0.2), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2), (0.0, 0.4))
"""radius and sigma; radius 0 is the paper's way"""
POINTS = 100_000
QUICK_POINTS = 2_000
SEED = 0
FILTERED_VIEWS = 3
PATIENCE = 12.0
"""for the rounds of one size, seconds"""


@dataclass(frozen=True)
class AppSubject:
    """A trained run of several levels, and views of it."""

    run: Any
    views: Sequence[Any]

    @property
    def view(self) -> Any:
        """The one that foveation is measured on."""
        return self.views[0]


def app_subject(run: Any, views: Sequence[Any]) -> AppSubject:
    """The run and a few of its views.

    Raises:
        BenchError: the scene has one level.
    """
    if int(run.gaussians.level.max()) < 2:
        raise BenchError("this scene has one level, and foveation and an index of the base are about several.")
    return AppSubject(run, [views[i] for i in spread(len(views), FILTERED_VIEWS)])


def apps_bench(options: BenchOptions, subject: AppSubject) -> Bench:
    """The benchmark; one step per image size, and one for the index."""
    sizes = QUICK_SIZES if options.quick else SIZES

    def run(tick: Tick) -> Measured:
        rows = []
        for width, height in sizes:
            tick(f"foveation at {width}x{height}")
            rows += foveation_rows(subject, width, height, options)
        tick("filters")
        filtered = draw_filters(subject.run, subject.views, {name: find_filter(name) for name in FILTERS})[0]
        tick("geometry")
        found = geometry_rows(subject.run.gaussians, QUICK_POINTS if options.quick else POINTS, options)
        return Measured([foveation_table(rows), filters_table(filtered), geometry_table(found)], {"points": SEED})

    return Bench("apps", ("foveation", "filters", "geometry"), len(sizes) + 2, run)


def foveation_rows(subject: AppSubject, width: int, height: int, options: BenchOptions) -> list[Row]:
    """Every setting at one image size, all of them timed in the same rounds."""
    camera, photo = enlarged(subject.view, width, height)
    fovea = _disc(width, height, FOVEA)
    pictures = {"everything": None, **{f"{r} {s}": Foveation(GAZE, s, r) for r, s in SETTINGS}}
    run = subject.run
    ways = {name: lambda a=attenuation: draw(run, camera, a).features for name, attenuation in pictures.items()}
    times = patient(ways, options.rounds, PATIENCE)
    full = draw(run, camera)
    rows: list[Row] = [_foveation_row(full, full, photo, fovea, times, "everything", (width, height))]
    for radius, sigma in SETTINGS:
        name = f"{radius} {sigma}"
        row = _foveation_row(draw(run, camera, pictures[name]), full, photo, fovea, times, name, (width, height))
        rows.append({**row, "radius": radius, "sigma": sigma})
    return rows


def _foveation_row(
    rendering: Any, full: Any, photo: Tensor, fovea: Bool[Tensor, "h w"], times: dict[str, Timing], name: str,
    size: tuple[int, int],
) -> Row:  # fmt: skip
    picture, whole = rendering.features.clamp(0, 1), full.features.clamp(0, 1)

    def lost(where: Tensor) -> float:
        return psnr(whole[where][None], photo[where][None]) - psnr(picture[where][None], photo[where][None])

    return {
        "size": size,
        "radius": None,
        "sigma": None,
        "drawn": int(rendering.info["drawn"]),
        "time": times[name],
        "faster": ratio(times["everything"], times[name]),
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
            ("radius", lambda row: "everything" if row["radius"] is None else f"{row['radius']:g}"),
            ("sigma", lambda row: "" if row["sigma"] is None else f"{row['sigma']:g}"),
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
        "picture. Radius 0 is the paper's way.",
    )


def filters_table(rows: Sequence[FilterRow]) -> BenchTable:
    """How much each filter changes, and how far it is the same from a step aside."""
    return BenchTable(
        "filters",
        "Filters",
        [vars(row) for row in rows],
        [
            ("filter", lambda row: row["name"]),
            ("Gaussians", lambda row: f"{row['gaussians']:,}"),
            ("changed, RMSE", lambda row: number(row["changed"])),
            ("step aside, RMSE", lambda row: number(row["step_aside"])),
            ("seen in both", lambda row: f"{row['shared']:.0%}"),
        ],
        f"At most {FILTERED_VIEWS} held-out views. *Changed*: against the plain pictures. *Step aside*: a second "
        f"picture from {STEP:.0%} of the depth to the right, its colours taken back to the first along that one's "
        "depth, against the first, where both show the same surface; so what moves with the picture instead of the "
        "scene counts as an error.",
    )


def geometry_rows(gaussians: Gaussians, count: int, options: BenchOptions) -> list[Row]:
    """Every prefix of levels against all levels: time to build, time to ask, and how far answers differ."""
    points = random_points(gaussians, count)
    levels = int(gaussians.level.max())
    truth = GeometryIndex(gaussians, levels).nearest(points)[0]
    size = float((points.amax(0) - points.amin(0)).norm())
    indices = {level: GeometryIndex(gaussians, level) for level in range(1, levels + 1)}
    asked = patient(
        {str(k): lambda i=index: i.nearest(points)[0] for k, index in indices.items()}, options.rounds, PATIENCE
    )
    rows = []
    for level, index in indices.items():
        off = (index.nearest(points)[0] - truth).abs() / size
        rows.append(
            {
                "level": level,
                "gaussians": len(index),
                "build": measure(lambda k=level: GeometryIndex(gaussians, k), min(options.rounds, 3), 1),
                "ask": asked[str(level)],
                "faster": ratio(asked[str(levels)], asked[str(level)]),
                "mean": float(off.mean()),
                "median": float(off.median()),
                "points": count,
            }
        )
    return rows


def random_points(gaussians: Gaussians, count: int) -> Float[Tensor, "count 3"]:
    """Uniform in the box of the centres, its outermost hundredth on each side left out."""
    ends = torch.quantile(gaussians.means.detach().cpu(), torch.tensor([0.01, 0.99]), dim=0)
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(SEED))
    return ends[0] + share * (ends[1] - ends[0])


def geometry_table(rows: Sequence[Row]) -> BenchTable:
    """Prefixes against all levels."""
    return BenchTable(
        "geometry",
        "Nearest Gaussian, asked of prefixes",
        rows,
        [
            ("levels", lambda row: "1" if row["level"] == 1 else f"1-{row['level']}"),
            ("Gaussians", lambda row: f"{row['gaussians']:,}"),
            ("build, ms", lambda row: milliseconds(row["build"])),
            ("ask, ms", lambda row: milliseconds(row["ask"])),
            ("times as fast", lambda row: number(row["faster"])),
            ("mean difference", lambda row: f"{row['mean']:.3%}"),
            ("median difference", lambda row: f"{row['median']:.3%}"),
        ],
        f"{rows[0]['points']:,} random points in the box that holds 98 % of the centres along each axis, one thread. "
        "*Difference*: of the distance to the nearest centre, against that of all levels, as a share of the box's "
        "diagonal.",
    )
