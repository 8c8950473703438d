"""What more threads gain: pictures and gradients of the numba backend with 1, 2, 4 ... threads, in turn."""

from collections.abc import Callable

import numba
import torch

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.runner import Tick, use_threads
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.bench.workloads import draw, draw_and_differentiate, workload
from freqgs_plugin.reports.timing import interleaved


def thread_counts() -> list[int]:
    """1, 2, 4 ... up to what numba may use here."""
    most: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
    return [2**k for k in range(most.bit_length())]


def thread_rows(name: str, options: BenchOptions, tick: Tick) -> list[Row]:
    """Times of one workload per number of threads, and whether picture and gradients keep their bits."""
    tick(f"{name}: threads")
    of, rasterizer = workload(name, options.quick), get_rasterizer("numba", "cpu", absgrad=False)

    def on(count: int, do: Callable) -> Callable:
        def timed() -> object:
            with use_threads(count):
                return do(rasterizer, of)

        return timed

    counts = thread_counts()
    forward = interleaved({str(n): on(n, draw) for n in counts}, options.rounds)
    both = interleaved({str(n): on(n, draw_and_differentiate) for n in counts}, options.rounds)
    answers = {}
    for n in counts:
        picture, gradients = on(n, draw_and_differentiate)()
        answers[n] = [picture, *gradients.values()]
    return [
        {
            "workload": name,
            "size": of.size,
            "threads": n,
            "forward": forward[str(n)],
            "forward_backward": both[str(n)],
            "forward_ratio": ratio(forward[str(n)], forward["1"]),
            "forward_backward_ratio": ratio(both[str(n)], both["1"]),
            "same_bits": all(map(torch.equal, answers[n], answers[1])),
        }
        for n in counts
    ]


def thread_table(rows: list[Row], sizes: str) -> BenchTable:
    return BenchTable(
        "raster-threads",
        "More threads, numba",
        rows,
        [
            ("workload", lambda row: row["workload"]),
            ("threads", lambda row: str(row["threads"])),
            ("forward, ms", lambda row: milliseconds(row["forward"])),
            ("both, ms", lambda row: milliseconds(row["forward_backward"])),
            ("forward / one thread", lambda row: number(row["forward_ratio"])),
            ("both / one thread", lambda row: number(row["forward_backward_ratio"])),
            ("same bits", lambda row: "yes" if row["same_bits"] else "no"),
        ],
        f"{sizes} *Both*: forward and backward. *Same bits*: picture and gradients, as with one thread.",
    )
