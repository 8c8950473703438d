"""`freqgs bench focus`: objects selected in several ways, against their true masks."""

from collections.abc import Callable, Sequence

import numpy as np

from freqgs_plugin.reports.bench.focus_cases import BOX_MARGIN, FocusSubject, Outcome, outcomes
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number
from freqgs_plugin.reports.timing import timing_of

TABLES = ("focus", "focus-times")
FEW = 4
"""views that vote in the ways called so"""
QUICK = 2
"""objects with --quick"""


def focus_bench(options: BenchOptions, subject: FocusSubject) -> Bench:
    """The benchmark; one step per object."""
    objects = subject.objects[:QUICK] if options.quick else subject.objects

    def measure(tick: Tick) -> Measured:
        rows = []
        for name, index in objects:
            tick(name)
            pixels = [int((view.ids == index).sum()) for view in subject.test]
            rows.append({"object": name, "pixels": float(np.mean(pixels)), **outcomes(subject, index, FEW)})
        return Measured([focus_table(rows, subject), time_table(rows, subject)])

    return Bench("focus", TABLES, len(objects), measure)


def focus_table(rows: Sequence[Row], subject: FocusSubject) -> BenchTable:
    views = len(subject.train)
    return BenchTable(
        "focus",
        "IoU of the rendered selection with the true mask, on held-out views",
        rows,
        [
            ("object", lambda row: row["object"]),
            ("pixels", lambda row: number(row["pixels"])),
            (f"weight, {views} masks", _iou("weight")),
            (f"centres, {views} masks", _iou("centres")),
            (f"weight, {FEW} masks", _iou("weight, few")),
            (f"centres, {FEW} masks", _iou("centres, few")),
            ("one box", _iou("box")),
            ("one point", _iou("point")),
            ("mask from box", lambda row: _share(row["box"].mask_iou)),
            ("mask from point", lambda row: _share(row["point"].mask_iou)),
        ],
        f"{len(subject.gaussians):,} Gaussians, {len(subject.test)} held-out views of {_size(subject)}, taken "
        "together. *Pixels*: of the true mask in a view, mean. *Weight*: `vote`; *centres*: `vote_by_centres`; with "
        f"true masks of all training views, or of {FEW} of them. *One box*, *one point*: on the training view that "
        f"shows most of the object, `mask_from_box` with the true bounding box widened by {BOX_MARGIN:.0%}, or "
        "`mask_from_point` at the pixel deepest inside, then `propagate` to the other views; the last two columns are "
        "the IoU of that first mask. Nothing is set per object.",
    )


def time_table(rows: Sequence[Row], subject: FocusSubject) -> BenchTable:
    views = len(subject.train)
    ways = {
        "weight": f"`vote`, {views} masks",
        "centres": f"`vote_by_centres`, {views} masks",
        "weight, few": f"`vote`, {FEW} masks",
        "centres, few": f"`vote_by_centres`, {FEW} masks",
        "box": f"`mask_from_box`, `propagate` to {views} views",
        "point": f"`mask_from_point`, `propagate` to {views} views",
    }
    times = [{"way": text, "time": timing_of([1000 * row[way].seconds for row in rows])} for way, text in ways.items()]
    return BenchTable(
        "focus-times",
        "Time for one object",
        times,
        [
            ("way", lambda row: row["way"]),
            ("time, ms", lambda row: milliseconds(row["time"])),
        ],
        f"Median (quartiles) over the {len(rows)} objects of the table before, each selected once.",
    )


def _iou(way: str) -> Callable[[Row], str]:
    def text(row: Row) -> str:
        outcome: Outcome = row[way]
        return _share(outcome.iou)

    return text


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _size(subject: FocusSubject) -> str:
    camera = subject.test[0].camera
    return f"{camera.width}x{camera.height} px"
