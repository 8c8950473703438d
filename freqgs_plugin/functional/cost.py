"""What a Gaussian costs in bytes and in milliseconds: turns budgets of megabytes and of time into counts."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from freqgs_plugin.functional.harmonics import num_coefficients

_REPEATS = 5
_PLAIN_FLOATS = 3 + 3 + 4 + 1
"""mean, scales, quaternion, opacity"""
_NORMAL_FLOATS = 3


def bytes_per_gaussian(storage: str, sh_degree: int, decay: bool = False) -> int:
    """Bytes of one Gaussian with harmonics up to `sh_degree`, and with a decay (4 more) where asked.

    `memory`: float32 parameters; `ply`: an uncompressed 3DGS PLY with normals (248 bytes at degree 3, with decay 252);
    `splat`: antimatter15's format, which holds neither harmonics nor decay (32 bytes).

    Raises:
        ValueError: another storage.
    """
    if storage == "splat":
        return 32
    if storage not in ("memory", "ply"):
        raise ValueError(f"storage is '{storage}'; choose memory, ply or splat.")
    floats = _PLAIN_FLOATS + 3 * num_coefficients(sh_degree) + (_NORMAL_FLOATS if storage == "ply" else 0) + decay
    return 4 * floats


def count_in_megabytes(megabytes: float | int, bytes_each: int) -> int:
    """How many Gaussians of `bytes_each` fit into `megabytes` (of 10^6 bytes).

    Raises:
        ValueError: not a positive number, or less than one Gaussian takes.
    """
    if not 0 < megabytes < math.inf:
        raise ValueError(f"the budget is {megabytes} MB; it must be a positive, finite number.")
    count = math.floor(megabytes * 1e6 / bytes_each)
    if count < 1:
        raise ValueError(
            f"a budget of {megabytes:g} MB is less than one Gaussian takes ({bytes_each} bytes); give at least "
            f"{bytes_each / 1e6:g} MB."
        )
    return count


@dataclass(frozen=True)
class Sample:
    """One measured picture."""

    drawn: int
    """Gaussians"""
    pixels: int
    milliseconds: float
    """median of several"""


@dataclass(frozen=True)
class RenderTime:
    """milliseconds = fixed + per_gaussian * drawn + per_pixel * pixels, as measured on one machine for one scene."""

    fixed: float
    """ms"""
    per_gaussian: float
    """ms"""
    per_pixel: float
    """ms; 0 where all pictures that were measured had one size: its part is in `fixed` then"""
    residual: float
    """root mean square of the fit's relative errors"""
    held_out_error: float
    """largest relative error at pictures that were not fitted; NaN where none was held out"""
    samples: tuple[Sample, ...]
    """all that was measured"""

    def milliseconds(self, drawn: int, pixels: int) -> float:
        """Predicted time of one picture."""
        return self.fixed + self.per_gaussian * drawn + self.per_pixel * pixels

    def count(self, milliseconds: float | int, pixels: int) -> int:
        """How many Gaussians can be drawn in `milliseconds` at `pixels`.

        Raises:
            ValueError: not a positive number, or less than a picture of one Gaussian takes.
        """
        if not 0 < milliseconds < math.inf:
            raise ValueError(f"the budget is {milliseconds} ms; it must be a positive, finite number.")
        least = self.milliseconds(1, pixels)
        if milliseconds < least:
            raise ValueError(
                f"a picture of {pixels:,} pixels takes {least:.3g} ms here with a single Gaussian, more than the "
                f"budget of {milliseconds:g} ms; give more time, or draw a smaller picture."
            )
        left = milliseconds - self.milliseconds(0, pixels)
        # where Gaussians cost nothing that could be measured, any number fits
        return min(math.floor(left / self.per_gaussian), 2**31 - 1) if self.per_gaussian > 0 else 2**31 - 1

    def __str__(self) -> str:
        size = f" + {self.per_pixel * 1e6:.3g} ms per million pixels" if self.per_pixel else ""
        error = f", off by up to {self.held_out_error:.0%} elsewhere" if not math.isnan(self.held_out_error) else ""
        return (
            f"{self.fixed:.3g} ms + {self.per_gaussian * 1e6:.3g} ms per million Gaussians{size} "
            f"(fitted to {self.residual:.0%}{error})"
        )


def calibrate(
    render_fn: Callable[[int, float], tuple[int, int]],
    largest: int,
    sizes: Sequence[float | int] = (1.0,),
    repeats: int = _REPEATS,
    clock: Callable[[], float | int] = time.perf_counter,
) -> RenderTime:
    """Measure `render_fn` on this machine: `render_fn(count, size)` draws about `count` Gaussians into a picture of
    `size` times the full side, waits until that is done, and returns how many Gaussians and pixels it drew.

    It is called with counts from `largest` / 16 to `largest` at each size, once to warm up and `repeats` times to be
    timed, of which the median counts. Counts in between are measured too and left out of the fit: they tell its error.

    Raises:
        ValueError: nothing to draw, or `render_fn` drew the same number whatever it was asked for.
    """
    if largest < 1 or repeats < 1 or not sizes:
        raise ValueError(f"calibration needs Gaussians, sizes and repeats, not {largest}, {list(sizes)}, {repeats}.")

    def measure(share: float | int, size: float | int) -> Sample:
        count = max(round(largest * share), 1)
        drawn, pixels = render_fn(count, size)
        times = []
        for _ in range(repeats):
            start = clock()
            render_fn(count, size)
            times.append((clock() - start) * 1e3)
        return Sample(drawn, pixels, statistics.median(times))

    fitted = [measure(share, size) for size in sizes for share in (1 / 16, 1 / 4, 1 / 2, 1)]
    held_out = [measure(share, size) for size in sizes for share in (1 / 8, 3 / 4)]
    return fit_render_time(fitted, held_out)


def fit_render_time(fitted: Sequence[Sample], held_out: Sequence[Sample] = ()) -> RenderTime:
    """Least squares of relative errors, no coefficient below 0. `held_out` only tells the error.

    Raises:
        ValueError: fewer than two counts, or a time that is not positive.
    """
    if len({s.drawn for s in fitted}) < 2:
        raise ValueError(
            f"pictures with {sorted({s.drawn for s in fitted})} Gaussians tell no cost per Gaussian; measure at least "
            "two different numbers."
        )
    if not all(0 < s.milliseconds < math.inf for s in (*fitted, *held_out)):
        raise ValueError(f"times must be positive and finite: {[s.milliseconds for s in (*fitted, *held_out)]} ms.")
    by_size = len({s.pixels for s in fitted}) > 1
    rows = np.array([[1.0, s.drawn, s.pixels if by_size else 0.0] for s in fitted])
    times = np.array([s.milliseconds for s in fitted])
    scale = np.maximum(rows.max(0), 1.0)
    solution, _ = nnls(rows / scale / times[:, None], np.ones(len(times)))
    fixed, per_gaussian, per_pixel = (float(c) for c in solution / scale)
    relative = rows @ np.array([fixed, per_gaussian, per_pixel]) / times - 1
    elsewhere = [abs((fixed + per_gaussian * s.drawn + per_pixel * s.pixels) / s.milliseconds - 1) for s in held_out]
    return RenderTime(
        fixed,
        per_gaussian,
        per_pixel,
        float(np.sqrt(np.mean(relative**2))),
        max(elsewhere, default=math.nan),
        (*fitted, *held_out),
    )
