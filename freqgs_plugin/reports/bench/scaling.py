"""`freqgs bench scaling`: time against the number of Gaussians and against the number of pixels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.fit import GROWN, PowerLaw, asymptotic
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.rounds import fitting
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds
from freqgs_plugin.reports.bench.workloads import (
    IMAGE_SEED,
    SCENE_SEED,
    Workload,
    draw,
    draw_and_differentiate,
    random_workload,
)
from freqgs_plugin.reports.timing import Timing, interleaved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BACKENDS = ("numba", "torch")
LIMIT = 20.0
"""a call that would take longer is left out, seconds"""
PATIENCE = 40.0
"""for the rounds of one size, seconds; there are at least two"""
SIZE = (0.005, 0.04)
"""standard deviations, world units"""


@dataclass(frozen=True)
class Sweep:
    """Workloads of growing size."""

    name: str
    """what grows"""
    fixed: str
    points: tuple[tuple[int, int, int], ...]
    """Gaussians, width and height, px"""

    def size(self, point: tuple[int, int, int]) -> int:
        n, width, height = point
        return n if self.name == "Gaussians" else width * height


def sweeps(quick: bool) -> list[Sweep]:
    """Both sweeps: by Gaussians at a fixed image, by pixels with fixed Gaussians."""
    if quick:
        counts, image, count, widths = (100, 300, 1_000, 3_000), (160, 120), 500, (40, 80, 160, 320)
    else:
        counts = (1_000, 3_162, 10_000, 31_623, 100_000, 316_228, 1_000_000)
        image, count, widths = (640, 480), 50_000, (100, 200, 400, 800, 1280, 1920)
    return [
        Sweep("Gaussians", f"{image[0]}x{image[1]} px", tuple((n, *image) for n in counts)),
        Sweep("pixels", f"{count:,} Gaussians", tuple((count, width, width * 3 // 4) for width in widths)),
    ]


def scaling_bench(options: BenchOptions) -> Bench:
    """The benchmark; one step per point."""
    both = sweeps(options.quick)

    def measure(tick: Tick) -> Measured:
        rows = [row for sweep in both for row in sweep_rows(sweep, options, tick)]
        laws = law_rows(rows)
        seeds = {"scene": SCENE_SEED, "image gradient": IMAGE_SEED}
        return Measured([law_table(laws, both), point_table(rows)], seeds, figure(rows, laws))

    return Bench("scaling", ("scaling", "scaling-points"), sum(len(sweep.points) for sweep in both), measure)


def sweep_rows(sweep: Sweep, options: BenchOptions, tick: Tick) -> list[Row]:
    """One row per point and backend; `forward` and `forward_backward` are None where it was left out."""
    rasterizers = {name: get_rasterizer(name, "cpu", absgrad=False) for name in BACKENDS}
    rows: list[Row] = []
    last: dict[str, tuple[int, float]] = {}
    for point in sweep.points:
        size = sweep.size(point)
        tick(f"{size:,} {sweep.name}")
        expected = {name: seconds * size / at for name, (at, seconds) in last.items()}
        going = [name for name in BACKENDS if expected.get(name, 0.0) <= LIMIT and (name in last or not rows)]
        of = random_workload(sweep.name, *point, size=SIZE)
        times = _times({name: rasterizers[name] for name in going}, of, options.rounds, sum(expected.values(), 0.0))
        last = {name: (size, times[name][1].median_ms / 1000) for name in going}
        for name in BACKENDS:
            forward, both = times.get(name, (None, None))
            row = {"sweep": sweep.name, "fixed": sweep.fixed, "size": size, "gaussians": point[0]}
            row |= {"width": point[1], "height": point[2], "backend": name}
            rows.append({**row, "forward": forward, "forward_backward": both})
    return rows


def _times(rasterizers: dict, of: Workload, rounds: int, expected: float) -> dict[str, tuple[Timing, Timing]]:
    """Forward, and forward and backward; fewer rounds where they would take long."""
    ways: dict[str, Callable[[], object]] = {}
    for name, rasterizer in rasterizers.items():
        ways[f"{name} forward"] = lambda r=rasterizer: draw(r, of)
        ways[f"{name} both"] = lambda r=rasterizer: draw_and_differentiate(r, of)
    # large ones come after small ones: what is loaded on first use is loaded
    times = interleaved(ways, fitting(rounds, PATIENCE, 1.4 * expected), warmup=int(1.4 * expected < PATIENCE / 2))
    return {name: (times[f"{name} forward"], times[f"{name} both"]) for name in rasterizers}


def law_rows(rows: Sequence[Row]) -> list[Row]:
    """The asymptotic power law of every sweep, backend and direction."""
    laws = []
    for sweep in dict.fromkeys(row["sweep"] for row in rows):
        for backend in BACKENDS:
            for way in ("forward", "forward_backward"):
                mine = [r for r in rows if (r["sweep"], r["backend"]) == (sweep, backend) and r[way] is not None]
                law = asymptotic([r["size"] for r in mine], [r[way].median_ms for r in mine])
                laws.append({"sweep": sweep, "backend": backend, "way": way, "law": law})
    return laws


def law_table(rows: list[Row], both: Sequence[Sweep]) -> BenchTable:
    def law(row: Row, text: Callable[[PowerLaw], str]) -> str:
        return "-" if row["law"] is None else text(row["law"])

    fixed = {sweep.name: sweep.fixed for sweep in both}
    return BenchTable(
        "scaling",
        "Growth of the time",
        rows,
        [
            ("what grows", lambda row: f"{row['sweep']} ({fixed[row['sweep']]})"),
            ("backend", lambda row: row["backend"]),
            ("time of", lambda row: row["way"].replace("_", " and ")),
            ("exponent", lambda row: law(row, lambda found: f"{found.exponent:.2f}")),
            ("fitted from", lambda row: law(row, lambda found: f"{found.first:,.0f} on")),
            ("points", lambda row: law(row, lambda found: str(found.points))),
            ("worst point off by", lambda row: law(row, lambda found: f"{100 * found.worst:.0f} %")),
        ],
        f"time = c size^exponent, by least squares of logarithms over the asymptotic part: from the first time that is "
        f"{GROWN:g} times that of the smallest size on, and at least the last three points.",
    )


def point_table(rows: list[Row]) -> BenchTable:
    return BenchTable(
        "scaling-points",
        "Times by size",
        rows,
        [
            ("what grows", lambda row: row["sweep"]),
            ("Gaussians", lambda row: f"{row['gaussians']:,}"),
            ("image", lambda row: f"{row['width']}x{row['height']}"),
            ("backend", lambda row: row["backend"]),
            ("forward, ms", lambda row: milliseconds(row["forward"])),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
            ("rounds", lambda row: "-" if row["forward"] is None else str(row["forward"].repeats)),
        ],
        f"*Both*: forward and backward. Medians (quartiles); rounds are fewer where they take long. A dash: a call "
        f"would have taken over {LIMIT:g} s. Gaussians are random, of {SIZE[0]:g} to {SIZE[1]:g} world units at depths "
        "2 to 6, and keep their size as they become more: pixels are then finished sooner. The focal length is the "
        "image's width, so larger images show the same scene.",
    )


def figure(rows: Sequence[Row], laws: Sequence[Row]) -> "Figure":
    """Both sweeps, doubly logarithmic; straight lines are the fitted laws."""
    from matplotlib.figure import Figure

    # Okabe and Ito, told apart by colour-blind readers
    colours = {"numba": "#0072B2", "torch": "#D55E00"}
    drawn = Figure(figsize=(10, 4.8), dpi=110, layout="constrained")
    names = list(dict.fromkeys(row["sweep"] for row in rows))
    for axes, sweep in zip(drawn.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for law in (law for law in laws if law["sweep"] == sweep):
            backend, way = law["backend"], law["way"]
            mine = [r for r in rows if (r["sweep"], r["backend"]) == (sweep, backend) and r[way] is not None]
            sizes, times = [r["size"] for r in mine], [r[way] for r in mine]
            both = way == "forward_backward"
            found: PowerLaw | None = law["law"]
            label = f"{backend}, {way.replace('_', ' + ')}" + (f": {found.exponent:.2f}" if found else "")
            spread = [[t.median_ms - t.low_ms for t in times], [t.high_ms - t.median_ms for t in times]]
            axes.errorbar(
                sizes,
                [t.median_ms for t in times],
                spread,
                color=colours[backend],
                marker="o" if both else "s",
                markerfacecolor=colours[backend] if both else "white",
                linestyle="none",
                label=label,
            )
            if found is not None:
                line = [size for size in sizes if size >= found.first]
                axes.plot(line, [found(size) for size in line], color=colours[backend], lw=1, ls="-" if both else "--")
        axes.set(xscale="log", yscale="log", xlabel=sweep, ylabel="ms")
        axes.set_title(next(row["fixed"] for row in rows if row["sweep"] == sweep), fontsize=10)
        axes.grid(alpha=0.3)
        where = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}
        axes.legend(fontsize=8, title="exponent of the line", title_fontsize=8, **where)
    return drawn
