"""`freqgs bench accuracy`: errors of every backend, and of every approximation, beside their times."""

from collections.abc import Callable, Sequence

import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.approximations import approximation_rows, approximation_table, variants
from freqgs_plugin.reports.bench.errors import errors
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number
from freqgs_plugin.reports.bench.workloads import (
    IMAGE_SEED,
    LEAVES,
    NAMES,
    SCENE_SEED,
    Workload,
    draw,
    draw_and_differentiate,
    workload,
)

PATIENCE = 40.0
"""for the rounds of one workload, seconds"""


def accuracy_bench(options: BenchOptions, trained: Workload | None = None) -> Bench:
    """The benchmark, on the random workloads and, if there is one, on a view of a trained scene."""

    def measure(tick: Tick) -> Measured:
        rows = []
        for name in NAMES:
            tick(f"{name}: backends")
            rows += backend_rows(workload(name, options.quick), options)
        if trained is not None:
            tick("trained view: backends")
            rows += backend_rows(trained, options)
        approximated = approximation_rows(workload("medium", options.quick), options, tick)
        seeds = {"scene": SCENE_SEED, "image gradient": IMAGE_SEED}
        return Measured([backend_table(rows), approximation_table(approximated)], seeds)

    steps = len(NAMES) + (trained is not None) + len(variants(options.quick)) + 1
    return Bench("accuracy", ("accuracy", "accuracy-approximations"), steps, measure)


def settings() -> dict[str, tuple[str, str, torch.dtype]]:
    """Label -> rasterizer, device, dtype; the first is the truth."""
    found = {
        "torch float64 (the truth)": ("torch", "cpu", torch.float64),
        "torch float32": ("torch", "cpu", torch.float32),
        "numba float32": ("numba", "cpu", torch.float32),
    }
    if torch.cuda.is_available():
        found["gsplat float32, CUDA"] = ("gsplat", "cuda", torch.float32)
    return found


def backend_rows(of: Workload, options: BenchOptions) -> list[Row]:
    """Errors and times of every setting on one workload."""
    results, forward, both = {}, {}, {}
    for label, (backend, device, dtype) in settings().items():
        rasterizer, here = get_rasterizer(backend, device, absgrad=False), of.to(device, dtype)
        results[label] = draw_and_differentiate(rasterizer, here)
        forward[f"{label} forward"] = lambda r=rasterizer, here=here: draw(r, here)
        both[f"{label} both"] = lambda r=rasterizer, here=here: draw_and_differentiate(r, here)
    truth = results[next(iter(results))]
    times = patient({**forward, **both}, options.rounds, PATIENCE)
    return [
        {
            "workload": of.name,
            "size": of.size,
            "backend": label,
            "errors": errors(*result, *truth),
            "forward": times[f"{label} forward"],
            "forward_backward": times[f"{label} both"],
        }
        for label, result in results.items()
    ]


def backend_table(rows: Sequence[Row]) -> BenchTable:
    def gradient(leaf: str) -> Callable[[Row], str]:
        return lambda row: number(row["errors"].gradients[leaf])

    sizes = "; ".join(dict.fromkeys(f"*{row['workload']}*: {row['size']}" for row in rows))
    return BenchTable(
        "accuracy",
        "Errors of the backends beside their times",
        rows,
        [
            ("workload", lambda row: row["workload"]),
            ("backend", lambda row: row["backend"]),
            ("largest", lambda row: number(row["errors"].largest)),
            ("RMS", lambda row: number(row["errors"].rms)),
            ("PSNR, dB", lambda row: f"{row['errors'].psnr:.1f}"),
            *((leaf, gradient(leaf)) for leaf in LEAVES),
            ("forward, ms", lambda row: milliseconds(row["forward"])),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
        ],
        f"{sizes}. The truth is the torch rasterizer in float64 with the same thresholds. *Largest*, *RMS*, *PSNR*: of "
        "the picture, for a peak of 1. The five columns after them: error of the gradient, as norm of the difference "
        "over norm of the truth. The largest errors are at pixels where rounding moves a contribution over the "
        "threshold of 1/255. *Both*: forward and backward.",
    )
