"""As many rounds as fit into a time."""

import time
from collections.abc import Callable, Mapping

from freqgs_plugin.reports.timing import Timing, interleaved

FEWEST = 2


def patient(candidates: Mapping[str, Callable[[], object]], rounds: int, seconds: float | int) -> dict[str, Timing]:
    """`interleaved`, after one run of each that is not counted; fewer rounds where `rounds` would take over `seconds`.

    At least FEWEST rounds (or `rounds`, if that is less), however long they take.
    """
    start = time.perf_counter()
    for function in candidates.values():
        function()
    return interleaved(candidates, fitting(rounds, seconds, time.perf_counter() - start), warmup=0)


def fitting(rounds: int, seconds: float | int, one: float | int) -> int:
    """How many rounds of `one` second each fit into `seconds`."""
    return min(rounds, max(FEWEST, int(seconds / one))) if one > 0 else rounds
