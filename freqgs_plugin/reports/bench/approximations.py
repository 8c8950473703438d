"""What each approximation of the compositors costs in accuracy and buys in time."""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.errors import Errors, errors
from freqgs_plugin.reports.bench.numba_variants import NumbaConstants, NumbaVariant
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.runner import Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.bench.variants import EXACT, Constants, constants
from freqgs_plugin.reports.bench.workloads import Workload, draw_and_differentiate, save_workload

PATIENCE = 100.0
"""for all rounds, seconds"""
SHIPPED = Constants()
_LOWER = 1e-6
"""the smallest alpha that float32 kernels are asked for instead of 1/255"""

APPROXIMATIONS: dict[str, tuple[Constants, torch.dtype | NumbaConstants]] = {
    "none: the exact sum, float64": (EXACT, torch.float64),
    "alpha under 1/255 is skipped": (replace(EXACT, alpha_min=SHIPPED.alpha_min), torch.float64),
    "stop at transmittance 1e-4": (replace(EXACT, stop=SHIPPED.stop), torch.float64),
    "culled at 3 sigma outside": (replace(EXACT, radius_sigmas=SHIPPED.radius_sigmas), torch.float64),
    "float32": (EXACT, torch.float32),
    "these three thresholds, float64": (SHIPPED, torch.float64),
    "torch as it is, tiles of 8 px": (SHIPPED, torch.float32),
    "torch, tiles of 16 px": (replace(SHIPPED, tile=16), torch.float32),
    "torch, tiles of 32 px": (replace(SHIPPED, tile=32), torch.float32),
    "numba as it is, tiles of 16 px": (SHIPPED, NumbaConstants()),
    "numba, tiles of 8 px": (SHIPPED, NumbaConstants(tile=8)),
    "numba, exact exponential": (SHIPPED, NumbaConstants(exact_exponential=True)),
    "numba, no stop": (replace(SHIPPED, stop=EXACT.stop), NumbaConstants(stop=0.0)),
    "numba, alpha from 1e-6, exact exponential": (
        replace(SHIPPED, alpha_min=_LOWER),
        NumbaConstants(alpha_min=_LOWER, exact_exponential=True),
    ),
}
"""label -> the constants, and the dtype of torch or how numba's kernels are compiled"""


def variants(quick: bool) -> dict[str, tuple[Constants, torch.dtype | NumbaConstants]]:
    """`APPROXIMATIONS`; `quick`: without those whose kernels must be compiled."""
    return {label: (values, how) for label, (values, how) in APPROXIMATIONS.items() if not (quick and compiles(how))}


def compiles(how: torch.dtype | NumbaConstants) -> bool:
    return isinstance(how, NumbaConstants) and how != NumbaConstants()


Result = tuple[torch.Tensor, dict[str, torch.Tensor]]


def approximation_rows(of: Workload, options: BenchOptions, tick: Tick) -> list[Row]:
    """Each variant against the exact sum, and against float64 with the variant's own constants."""
    chosen = variants(options.quick)
    torch_rasterizer, double = get_rasterizer("torch", "cpu", absgrad=False), of.to("cpu", torch.float64)

    def in_torch(values: Constants, here: Workload) -> Result:
        with constants(values):
            return draw_and_differentiate(torch_rasterizer, here)

    results: dict[str, Result] = {}
    same: dict[Constants, Result] = {}
    ways: dict[str, Callable[[], Any]] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="freqgs-bench-")))
        save_workload(of, folder / "workload.pt")
        children: dict[str, NumbaVariant] = {}
        for label, (_, how) in chosen.items():
            if isinstance(how, NumbaConstants):
                # all of them compile while torch works
                child = stack.enter_context(NumbaVariant(folder / "workload.pt", options.threads, how))
                child.begin("both")
                children[label] = child
        for label, (values, how) in chosen.items():
            tick(f"approximations: {label}")
            if values not in same:
                same[values] = in_torch(values, double)
            if isinstance(how, NumbaConstants):
                child = children[label]
                child.finish()
                results[label] = child.result()
                ways[label] = lambda child=child: child.milliseconds("both")
            else:
                here = of.to("cpu", how)
                results[label] = in_torch(values, here)
                ways[label] = lambda values=values, here=here: in_torch(values, here)
        tick("approximations: times")
        times = patient(ways, options.rounds, PATIENCE)
    exact = same[EXACT]
    return [
        {
            "workload": of.name,
            "size": of.size,
            "approximation": label,
            "errors": errors(*results[label], *exact),
            "own_errors": errors(*results[label], *same[values]),
            "forward_backward": times[label],
            "ratio": ratio(times[label], times[next(iter(chosen))]),
        }
        for label, (values, _) in chosen.items()
    ]


def approximation_table(rows: Sequence[Row]) -> BenchTable:
    def error(which: str, show: Callable[[Errors], str]) -> Callable[[Row], str]:
        return lambda row: show(row[which])

    return BenchTable(
        "accuracy-approximations",
        "What each approximation costs and buys",
        rows,
        [
            ("approximation", lambda row: row["approximation"]),
            ("largest", error("errors", lambda e: number(e.largest))),
            ("RMS", error("errors", lambda e: number(e.rms))),
            ("PSNR, dB", error("errors", lambda e: f"{e.psnr:.1f}")),
            ("gradient", error("errors", lambda e: number(e.worst_gradient))),
            ("rounding, largest", error("own_errors", lambda e: number(e.largest))),
            ("rounding, gradient", error("own_errors", lambda e: number(e.worst_gradient))),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
            ("/ exact", lambda row: number(row["ratio"])),
        ],
        f"Workload {rows[0]['workload']}: {rows[0]['size']}. The first four columns: against the exact sum, in which "
        "every Gaussian reaches to 7.4 standard deviations and no pixel is ever finished. *Gradient*: the worst of the "
        "five parameters, as norm of the difference over norm of the truth. *Rounding*: against float64 with the "
        "thresholds of the row itself, so that what remains is float32 and, for numba, the exponential. The rows above "
        "*these three thresholds* have one approximation each. Projection is in float64 everywhere. *Both*: forward "
        "and backward.",
    )
