"""`freqgs bench cuda`: gsplat's kernels beside the torch reference, both on CUDA; times, memory and errors."""

from collections.abc import Sequence

import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.errors import errors
from freqgs_plugin.reports.bench.memory import peak_memory
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.raster import sizes_of
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.bench.workloads import (
    IMAGE_SEED,
    LEAVES,
    NAMES,
    SCENE_SEED,
    draw,
    draw_and_differentiate,
    workload,
)
from freqgs_plugin.reports.timing import interleaved

BASELINE = "torch"
BACKENDS = (BASELINE, "gsplat")


def cuda_bench(options: BenchOptions) -> Bench:
    """The benchmark; each workload takes one step per backend for memory and one for the rest.

    Raises:
        BenchError: there is no CUDA device.
    """
    if not torch.cuda.is_available():
        raise BenchError("freqgs bench cuda needs a CUDA device, and torch finds none. On a CPU: freqgs bench raster.")

    def measure(tick: Tick) -> Measured:
        rows = [row for name in NAMES for row in cuda_rows(name, options, tick)]
        return Measured([cuda_table(rows)], {"scene": SCENE_SEED, "image gradient": IMAGE_SEED})

    return Bench("cuda", ("cuda",), len(NAMES) * (len(BACKENDS) + 1), measure)


def cuda_rows(name: str, options: BenchOptions, tick: Tick, device: str = "cuda") -> list[Row]:
    """Times, ratios to the baseline, peak memory and errors against float64 on one workload."""
    memory = {}
    for backend in BACKENDS:
        tick(f"{name}: memory of {backend}")
        memory[backend] = peak_memory(name, backend, device, options.threads, options.quick)
    tick(f"{name}: times and errors")
    of = workload(name, options.quick)
    truth = draw_and_differentiate(get_rasterizer("torch", "cpu", absgrad=False), of.to("cpu", torch.float64))
    here = of.to(device)
    rasterizers = {backend: get_rasterizer(backend, device, absgrad=False) for backend in BACKENDS}
    forward = interleaved({k: lambda r=r: draw(r, here) for k, r in rasterizers.items()}, options.rounds)
    both = interleaved({k: lambda r=r: draw_and_differentiate(r, here) for k, r in rasterizers.items()}, options.rounds)
    return [
        {
            "workload": name,
            "size": of.size,
            "backend": backend,
            "forward": forward[backend],
            "forward_backward": both[backend],
            "forward_ratio": ratio(forward[backend], forward[BASELINE]),
            "forward_backward_ratio": ratio(both[backend], both[BASELINE]),
            "memory_mib": memory[backend],
            "errors": errors(*draw_and_differentiate(rasterizers[backend], here), *truth),
        }
        for backend in BACKENDS
    ]


def cuda_table(rows: Sequence[Row]) -> BenchTable:
    failed = [f"{row['backend']}: {row['memory_mib']['error']}" for row in rows if "error" in row["memory_mib"]]
    return BenchTable(
        "cuda",
        "Rasterizers on CUDA",
        list(rows),
        [
            ("workload", lambda row: row["workload"]),
            ("backend", lambda row: row["backend"]),
            ("forward, ms", lambda row: milliseconds(row["forward"])),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
            ("forward / torch", lambda row: number(row["forward_ratio"])),
            ("both / torch", lambda row: number(row["forward_backward_ratio"])),
            ("forward, MiB", lambda row: number(row["memory_mib"].get("forward"))),
            ("both, MiB", lambda row: number(row["memory_mib"].get("forward_backward"))),
            ("PSNR, dB", lambda row: f"{row['errors'].psnr:.1f}"),
            *((leaf, lambda row, leaf=leaf: number(row["errors"].gradients[leaf])) for leaf in LEAVES),
        ],
        f"{sizes_of(rows)} *Both*: forward and backward. Times: medians (quartiles), until the device has finished. "
        "Memory: what torch's allocator holds at most above what it held before, in a process of its own. *PSNR* and "
        "the columns after it: of the picture, and relative errors of the gradients, against the torch rasterizer in "
        "float64 on the CPU. gsplat lists the tiles of a box of 3 standard deviations, the others those where alpha "
        "reaches 1/255, so their pictures differ." + "".join(f" No memory figure for {reason}." for reason in failed),
    )
