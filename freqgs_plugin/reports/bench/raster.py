"""`freqgs bench raster`: every backend on three workloads; prefixes in one pass; time against what is drawn."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay, LevelCut
from freqgs_plugin.rendering.base import Rasterizer, get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.bench.memory import peak_memory
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.raster_threads import thread_rows, thread_table
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Column, Row, milliseconds, number, ratio
from freqgs_plugin.reports.bench.workloads import (
    DETAIL_SEED,
    IMAGE_SEED,
    LEAVES,
    NAMES,
    SCENE_SEED,
    Workload,
    draw,
    draw_and_differentiate,
    random_levels,
    with_detail,
    workload,
)
from freqgs_plugin.reports.timing import interleaved
from freqgs_plugin.types import Splats

PREFIX_COUNTS = (3, 5)
PREFIX_WORKLOADS = ("medium", "large")
SHARE_SCALES = (1.0, 2.0, 5.0)


def raster_bench(options: BenchOptions) -> Bench:
    """The benchmark; each workload takes one step per backend for memory and one for the times."""
    contenders = backends()

    def measure(tick: Tick) -> Measured:
        return Measured(
            [
                backend_table([row for name in NAMES for row in backend_rows(name, contenders, options, tick)]),
                prefix_table([row for name in PREFIX_WORKLOADS for row in prefix_rows(name, options, tick)]),
                share_table(share_rows("large", options, tick)),
                thread_table(
                    threads := [row for name in NAMES for row in thread_rows(name, options, tick)], sizes_of(threads)
                ),
            ],
            {"scene": SCENE_SEED, "image gradient": IMAGE_SEED, "levels and decays": DETAIL_SEED},
        )

    steps = len(NAMES) * (len(contenders) + 1) + len(PREFIX_WORKLOADS) + 1 + len(NAMES)
    return Bench("raster", ("raster", "raster-prefixes", "raster-shares", "raster-threads"), steps, measure)


def backends() -> list[tuple[str, str]]:
    """(rasterizer, device) of every one that runs here, the baseline first."""
    cuda = [("torch", "cuda"), ("gsplat", "cuda")] if torch.cuda.is_available() else []
    return [("torch", "cpu"), ("numba", "cpu"), *cuda]


def backend_rows(name: str, contenders: list[tuple[str, str]], options: BenchOptions, tick: Tick) -> list[Row]:
    """Times, ratios to the first of `contenders` (rasterizer, device), and peak memory on one workload."""
    baseline = ", ".join(contenders[0])
    memory: dict[str, Any] = {}
    forward: dict[str, Callable[[], object]] = {}
    both: dict[str, Callable[[], object]] = {}
    for backend, device in contenders:
        label = f"{backend}, {device}"
        tick(f"{name}: memory of {label}")
        memory[label] = peak_memory(name, backend, device, options.threads, options.quick)
        rasterizer, of = get_rasterizer(backend, device, absgrad=False), workload(name, options.quick).to(device)
        forward[label] = lambda rasterizer=rasterizer, of=of: draw(rasterizer, of)
        both[label] = lambda rasterizer=rasterizer, of=of: draw_and_differentiate(rasterizer, of)
    tick(f"{name}: times")
    drawn, differentiated = interleaved(forward, options.rounds), interleaved(both, options.rounds)
    return [
        {
            "workload": name,
            "size": workload(name, options.quick).size,
            "backend": label,
            "forward": drawn[label],
            "forward_backward": differentiated[label],
            "forward_ratio": ratio(drawn[label], drawn[baseline]),
            "forward_backward_ratio": ratio(differentiated[label], differentiated[baseline]),
            "memory_mib": memory[label],
        }
        for label in forward
    ]


def backend_columns() -> list[Column]:
    """Of `backend_rows`: times, ratios and memory."""

    def memory(row: Row, which: str) -> str:
        return number(row["memory_mib"].get(which))

    return [
        ("workload", lambda row: row["workload"]),
        ("backend", lambda row: row["backend"]),
        ("forward, ms", lambda row: milliseconds(row["forward"])),
        ("both, ms", lambda row: milliseconds(row["forward_backward"])),
        ("forward / torch", lambda row: number(row["forward_ratio"])),
        ("both / torch", lambda row: number(row["forward_backward_ratio"])),
        ("forward, MiB", lambda row: memory(row, "forward")),
        ("both, MiB", lambda row: memory(row, "forward_backward")),
    ]


def backend_note(rows: Sequence[Row]) -> str:
    """What the columns of `backend_columns` mean, and why a memory figure is missing."""
    failed = [f"{row['backend']}: {row['memory_mib']['error']}" for row in rows if "error" in row["memory_mib"]]
    return (
        f"{sizes_of(rows)} *Both*: forward and backward. Times: medians (quartiles). Colours are given: no harmonics "
        "are evaluated. Gradients: of all five tensors of the "
        "splats, without absolute gradients. Memory: what the process holds at most above what it held before, each in "
        "a process of its own; on CUDA, torch's allocator."
        + "".join(f" No memory figure for {reason}." for reason in failed)
    )


def backend_table(rows: list[Row]) -> BenchTable:
    return BenchTable("raster", "Rasterizers", rows, backend_columns(), backend_note(rows))


def sizes_of(rows: Sequence[Row]) -> str:
    """The workloads of a table with their sizes, for its note."""
    return "; ".join(dict.fromkeys(f"*{row['workload']}*: {row['size']}" for row in rows)) + "."


def prefix_rows(name: str, options: BenchOptions, tick: Tick) -> list[Row]:
    """All prefixes of random levels by numba: in one pass, and with a call for each, against one picture."""
    tick(f"{name}: prefixes")
    of, rasterizer = workload(name, options.quick), get_rasterizer("numba", "cpu")
    ways: dict[str, Callable[[Splats], list[Tensor]]] = {
        "one picture": lambda splats: [_picture(rasterizer, splats, of)]
    }
    for count in PREFIX_COUNTS:
        level = random_levels(len(of.splats), count)
        ways[f"{count} prefixes, one pass"] = lambda splats, level=level, count=count: [
            r.features
            for r in rasterizer.prefixes(splats, level, count, of.camera, background=of.background)  # pyright: ignore
        ]
        ways[f"{count} prefixes, a call for each"] = lambda splats, level=level, count=count: [
            _picture(rasterizer, splats.select(level <= k), of) for k in range(1, count + 1)
        ]
    forward = interleaved({k: lambda way=way: _without_gradient(way, of) for k, way in ways.items()}, options.rounds)
    both = interleaved({k: lambda way=way: _with_gradient(way, of) for k, way in ways.items()}, options.rounds)
    return [
        {
            "workload": name,
            "size": of.size,
            "way": way,
            "forward": forward[way],
            "forward_backward": both[way],
            "forward_ratio": ratio(forward[way], forward["one picture"]),
            "forward_backward_ratio": ratio(both[way], both["one picture"]),
        }
        for way in ways
    ]


def _picture(rasterizer: Rasterizer, splats: Splats, of: Workload) -> Tensor:
    return rasterizer(splats, of.camera, background=of.background, depth=False).features


def _without_gradient(way: Callable[[Splats], list[Tensor]], of: Workload) -> None:
    with torch.no_grad():
        way(of.splats)


def _with_gradient(way: Callable[[Splats], list[Tensor]], of: Workload) -> None:
    leaves = {name: getattr(of.splats, name).clone().requires_grad_() for name in LEAVES}
    torch.stack([(picture * of.gradient).sum() for picture in way(Splats(**leaves))]).sum().backward()


def prefix_table(rows: list[Row]) -> BenchTable:
    return BenchTable(
        "raster-prefixes",
        "All prefixes of levels against one picture, numba",
        rows,
        [
            ("workload", lambda row: row["workload"]),
            ("what", lambda row: row["way"]),
            ("forward, ms", lambda row: milliseconds(row["forward"])),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
            ("forward / one", lambda row: number(row["forward_ratio"])),
            ("both / one", lambda row: number(row["forward_backward_ratio"])),
        ],
        f"{sizes_of(rows)} *Both*: forward and backward. *One*: one picture. Levels are random, each with an equal "
        "share of the Gaussians. A gradient goes back through every prefix.",
    )


def share_rows(name: str, options: BenchOptions, tick: Tick) -> list[Row]:
    """Viewing with less detail: what is drawn, and how long it takes, against everything."""
    tick(f"{name}: shares")
    of, rasterizer = workload(name, options.quick), get_rasterizer("numba", "cpu")
    gaussians = with_detail(of, 3)
    # the middle of the depths is a distance of 1
    ways: dict[str, Attenuation | None] = {"everything": None}
    ways |= {"level 1 of 3": LevelCut(1), "levels 1-2 of 3": LevelCut(2)}
    ways |= {f"distance decay, scale {scale:g}": DistanceDecay(scale, scene_distance=4.0) for scale in SHARE_SCALES}

    def view(attenuation: Attenuation | None) -> int:
        with torch.no_grad():
            options = {"rasterizer": rasterizer, "background": of.background, "depth": False}
            return render(gaussians, of.camera, attenuation, **options).info["drawn"]

    drawn = {way: view(attenuation) for way, attenuation in ways.items()}
    times = interleaved({way: lambda a=a: view(a) for way, a in ways.items()}, options.rounds)
    return [
        {
            "workload": name,
            "size": of.size,
            "way": way,
            "drawn": drawn[way],
            "drawn_share": drawn[way] / drawn["everything"],
            "time": times[way],
            "time_share": ratio(times[way], times["everything"]),
        }
        for way in ways
    ]


def share_table(rows: list[Row]) -> BenchTable:
    return BenchTable(
        "raster-shares",
        "Viewing with less detail, numba",
        rows,
        [
            ("workload", lambda row: row["workload"]),
            ("drawn", lambda row: row["way"]),
            ("Gaussians", lambda row: f"{row['drawn']:,}"),
            ("of all Gaussians", lambda row: f"{100 * row['drawn_share']:.1f} %"),
            ("time, ms", lambda row: milliseconds(row["time"])),
            ("of all time", lambda row: f"{100 * row['time_share']:.1f} %"),
        ],
        f"{sizes_of(rows)} The whole path of a picture: attenuation, harmonics of degree 3, rasterizer. Rows of weight "
        "0 are dropped. Levels are random thirds; decays are random, log-uniform in 0.1 to 3 of the distance 4.",
    )
