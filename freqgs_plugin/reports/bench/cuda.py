"""`freqgs bench cuda`: gsplat's kernels beside the torch reference, both on CUDA; times, memory and errors."""

from collections.abc import Sequence

import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.errors import errors
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.raster import backend_columns, backend_note, backend_rows
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, number
from freqgs_plugin.reports.bench.workloads import (
    IMAGE_SEED,
    LEAVES,
    NAMES,
    SCENE_SEED,
    draw_and_differentiate,
    workload,
)

CONTENDERS = [("torch", "cuda"), ("gsplat", "cuda")]


def cuda_bench(options: BenchOptions) -> Bench:
    """The benchmark; each workload takes one step per backend for memory and one for the times.

    Raises:
        BenchError: there is no CUDA device.
    """
    if not torch.cuda.is_available():
        raise BenchError("freqgs bench cuda needs a CUDA device, and torch finds none. On a CPU: freqgs bench raster.")

    def measure(tick: Tick) -> Measured:
        rows = [row for name in NAMES for row in with_errors(backend_rows(name, CONTENDERS, options, tick), options)]
        return Measured([cuda_table(rows)], {"scene": SCENE_SEED, "image gradient": IMAGE_SEED})

    return Bench("cuda", ("cuda",), len(NAMES) * (len(CONTENDERS) + 1), measure)


def with_errors(rows: Sequence[Row], options: BenchOptions) -> list[Row]:
    """The rows with `errors` against the torch rasterizer in float64 on the CPU."""
    found = []
    for row in rows:
        of = workload(row["workload"], options.quick)
        truth = draw_and_differentiate(get_rasterizer("torch", "cpu", absgrad=False), of.to("cpu", torch.float64))
        backend, device = row["backend"].split(", ")
        actual = draw_and_differentiate(get_rasterizer(backend, device, absgrad=False), of.to(device))
        found.append({**row, "errors": errors(*actual, *truth)})
    return found


def cuda_table(rows: Sequence[Row]) -> BenchTable:
    return BenchTable(
        "cuda",
        "Rasterizers on CUDA",
        list(rows),
        [
            *backend_columns(),
            ("PSNR, dB", lambda row: f"{row['errors'].psnr:.1f}"),
            *((leaf, lambda row, leaf=leaf: number(row["errors"].gradients[leaf])) for leaf in LEAVES),
        ],
        f"{backend_note(rows)} *PSNR* and the columns after it: of the picture, and relative errors of the gradients, "
        "against the torch rasterizer in float64 on the CPU. gsplat lists the tiles of a box of 3 standard deviations, "
        "the others those where alpha reaches 1/255, so their pictures differ.",
    )
