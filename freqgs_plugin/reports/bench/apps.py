"""`freqgs bench apps`: what foveation and an index of the base gain on a trained run, what they lose, and filters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.apps.filters import FILTERS
from freqgs_plugin.apps.geometry import GeometryIndex
from freqgs_plugin.apps.own_filters import find_filter
from freqgs_plugin.reports.bench.foveation import QUICK_SIZES, SIZES, foveation_figure, foveation_rows, foveation_table
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.filters import STEP, FilterRow, draw_filters, spread
from freqgs_plugin.reports.timing import measure
from freqgs_plugin.types import Gaussians

TABLES = ("foveation", "filters", "geometry")
POINTS = 100_000
QUICK_POINTS = 2_000
SEED = 0
FILTERED_VIEWS = 3
PATIENCE = 12.0
"""for the rounds of asking an index, seconds"""


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
            rows += foveation_rows(subject.run, subject.view, width, height, options)
        tick("filters")
        filtered = draw_filters(subject.run, subject.views, {name: find_filter(name) for name in FILTERS})[0]
        tick("geometry")
        found = geometry_rows(subject.run.gaussians, QUICK_POINTS if options.quick else POINTS, options)
        tables = [foveation_table(rows), filters_table(filtered), geometry_table(found)]
        return Measured(tables, {"points": SEED}, foveation_figure(rows))

    return Bench("apps", TABLES, len(sizes) + 2, run)


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
