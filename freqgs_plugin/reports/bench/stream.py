"""`freqgs bench stream`: error against bytes of every variant, pictures by bytes received, and times on slow lines."""

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.stream_measure import (
    Point,
    StreamSubject,
    Times,
    curve,
    pictures,
    ply_of,
    ply_seconds,
    quality,
    stream_times,
)
from freqgs_plugin.reports.bench.stream_verdict import CLOSE, COVERED, CURVE, complete_from, milestones, verdict
from freqgs_plugin.reports.bench.tables import BenchTable, Row, number
from freqgs_plugin.stream.enlarging import SHARE
from freqgs_plugin.stream.quantise import VARIANTS
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.write import Stream, StreamOptions, encode_stream, save_stream

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLES = ("stream-curve", "stream-variants", "stream-lines")
LINES = (1.0, 10.0, 100.0)
"""Mbit/s"""


def stream_bench(options: BenchOptions, subjects: Sequence[StreamSubject]) -> Bench:
    """The benchmark; a step per variant, curve and line, of every subject."""
    variants = [CURVE] if options.quick else list(VARIANTS)
    lines = LINES[-1:] if options.quick else LINES

    def measure(tick: Tick) -> Measured:
        found: list[Row] = []
        curves: dict[str, list[Point]] = {}
        plys: dict[str, int] = {}
        times: list[Row] = []
        for subject in subjects:
            with tempfile.TemporaryDirectory() as folder:
                ply = Path(folder) / "ply" / "scene.ply"
                ply.parent.mkdir()
                plys[subject.name] = ply_of(subject.scene.gaussians, subject.scene.antialiased, ply)
                kept: Stream | None = None
                for variant in variants:
                    tick(f"{subject.name}, {variant}")
                    row, stream = variant_row(subject, variant, plys[subject.name])
                    found.append(row)
                    kept = stream if variant == CURVE else kept
                assert kept is not None
                tick(f"{subject.name}, curve")
                curves[subject.name] = curve(subject, kept)
                save_stream(kept, Path(folder) / "stream")
                for mbits in lines:
                    tick(f"{subject.name}, {mbits:g} Mbit/s")
                    complete = complete_from(curves[subject.name])
                    times.append(line_row(subject.name, mbits, Path(folder) / "stream", ply, complete))
        tables = [curve_table(curves, plys, found), variant_table(found), line_table(times)]
        return Measured(tables, figure=figure(curves, plys, found))

    steps = len(subjects) * (len(variants) + 1 + len(lines))
    return Bench("stream", TABLES, steps, measure)


def variant_row(subject: StreamSubject, variant: str, ply_bytes: int) -> tuple[Row, Stream]:
    """Bytes, error and time of one variant."""
    start = time.perf_counter()
    stream = encode_stream(subject.scene, StreamOptions(variant))
    written = time.perf_counter()
    received = Received(stream.manifest)
    for chunk in stream.manifest.chunks:
        received.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
    gaussians = received.gaussians()
    read = time.perf_counter()
    own, found = pictures(subject, subject.scene.gaussians), pictures(subject, gaussians)
    photographs = [view.image for view in subject.views]
    total = stream.manifest.bytes + len(stream.manifest.text())
    count = stream.manifest.count
    return {
        "scene": subject.name,
        "variant": variant,
        "bytes": total,
        "each": total / count,
        "share": total / ply_bytes,
        "own": quality(found, own),
        "photographs": quality(found, photographs),
        "loss": quality(own, photographs) - quality(found, photographs),
        "write_s": written - start,
        "read_s": read - written,
    }, stream


def line_row(name: str, mbits: float, stream: Path, ply: Path, complete: int) -> Row:
    """Seconds on one line."""
    times = stream_times(stream, mbits, complete)
    return {"scene": name, "mbits": mbits, "stream": times, "ply": ply_seconds(ply, mbits)}


def curve_table(curves: Mapping[str, list[Point]], plys: Mapping[str, int], variants: Sequence[Row]) -> BenchTable:
    rows = [
        {
            "scene": name,
            "what": what,
            "bytes": point.bytes,
            "of_stream": point.bytes / points[-1].bytes,
            "of_ply": point.bytes / plys[name],
            "photographs": point.photographs,
            "own": point.complete,
            "covered": point.covered,
            "gaussians": point.gaussians,
        }
        for name, points in curves.items()
        for what, point in milestones(points)
    ]
    told = [
        verdict(name, points, plys[name], [row for row in variants if row["scene"] == name])
        for name, points in curves.items()
    ]
    return BenchTable(
        "stream-curve",
        "Pictures by bytes received",
        rows,
        [
            ("scene", lambda row: row["scene"]),
            ("received", lambda row: row["what"]),
            ("Gaussians", lambda row: f"{row['gaussians']:,}"),
            ("kB", lambda row: number(row["bytes"] / 1e3)),
            ("of the stream", lambda row: f"{row['of_stream']:.1%}"),
            ("of a PLY", lambda row: f"{row['of_ply']:.1%}"),
            ("PSNR, photographs, dB", lambda row: f"{row['photographs']:.2f}"),
            ("PSNR, run's own picture, dB", lambda row: f"{row['own']:.2f}"),
            ("no holes", lambda row: f"{row['covered']:.1%}"),
        ],
        f"Variant {CURVE}, held-out views, the manifest counted; PLY without normals. *No holes*: pixels with at "
        f"least {SHARE:.0%} of the alpha of the whole base, of the view that has least of them; *without holes*: from "
        f"here on at least {COVERED:.0%}; *complete picture*: from here on also at most {CLOSE:g} dB further from the "
        "run's own picture than the whole base is. " + " ".join(told),
    )


def variant_table(rows: Sequence[Row]) -> BenchTable:
    return BenchTable(
        "stream-variants",
        "Error against bytes",
        rows,
        [
            ("scene", lambda row: row["scene"]),
            ("variant", lambda row: row["variant"]),
            ("kB", lambda row: number(row["bytes"] / 1e3)),
            ("bytes per Gaussian", lambda row: number(row["each"])),
            ("of a PLY", lambda row: f"{row['share']:.1%}"),
            ("PSNR, run's own picture, dB", lambda row: f"{row['own']:.1f}"),
            ("PSNR, photographs, dB", lambda row: f"{row['photographs']:.2f}"),
            ("loss, dB", lambda row: f"{row['loss']:.3f}"),
            ("writing, s", lambda row: number(row["write_s"])),
            ("reading, s", lambda row: number(row["read_s"])),
        ],
        "*Exact* keeps every bit of every number; its pictures differ from the run's only where Gaussians at the same "
        "depth change places. *Writing* includes finding the order, *reading* is without the line. One run of each.",
    )


def line_table(rows: Sequence[Row]) -> BenchTable:
    def of_stream(name: str) -> Any:
        return lambda row: number(getattr(row["stream"], name))

    def gain(row: Row) -> str:
        times: Times = row["stream"]
        return f"{row['ply'] / times.complete:.0f}x, {row['ply'] / times.full:.1f}x"

    return BenchTable(
        "stream-lines",
        "Seconds until something is seen",
        rows,
        [
            ("scene", lambda row: row["scene"]),
            ("Mbit/s", lambda row: number(row["mbits"])),
            ("first chunk, s", of_stream("first")),
            ("complete picture, s", of_stream("complete")),
            ("base, s", of_stream("base")),
            ("everything, s", of_stream("full")),
            ("PLY, s", lambda row: number(row["ply"])),
            ("sooner: complete, everything", gain),
        ],
        f"Variant {CURVE}, over loopback at the speed named, without delay; decoding included, drawing not. *Complete "
        "picture*: as in the table above. *Base*: all of its Gaussians, in constant colours. Of the PLY nothing is "
        "seen before all of it has arrived. One run.",
    )


def figure(curves: Mapping[str, list[Point]], plys: Mapping[str, int], variants: Sequence[Row]) -> "Figure":
    """PSNR against bytes of every scene; dots are whole streams of the variants, the cross is the PLY."""
    from freqgs_plugin.reports.experiments.plots import COLOURS, GREY, panels

    drawn, axes = panels(len(curves))
    for each, (name, points) in zip(axes, curves.items(), strict=True):
        colours = iter(COLOURS)
        levels = sorted({p.level for p in points})
        for level in levels:
            mine = [p for p in points if p.level == level]
            label = f"level {level}" if len(levels) > 1 else "balanced"
            each.plot(
                [p.bytes / 1e6 for p in mine],
                [p.photographs for p in mine],
                marker=".",
                color=next(colours),
                label=label,
            )
        for row in (row for row in variants if row["scene"] == name):
            each.plot(row["bytes"] / 1e6, row["photographs"], "o", color=GREY, markerfacecolor="white", zorder=1)
            place, turn = (row["bytes"] / 1e6, row["photographs"]), {"rotation": -50, "rotation_mode": "anchor"}
            each.annotate(row["variant"], place, (4, -8), fontsize=7, textcoords="offset points", va="top", **turn)
            best = row["photographs"] + row["loss"]
        each.plot(plys[name] / 1e6, best, "x", color="black", label="PLY")
        each.set(title=name, xlabel="MB received", ylabel="PSNR, photographs, dB", xscale="log")
        each.legend(fontsize=8)
    return drawn
