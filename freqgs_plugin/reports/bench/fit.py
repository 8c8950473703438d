"""Power laws through measured times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GROWN = 5.0
"""a time at least this many times the one of the smallest size belongs to the asymptotic part"""
FEWEST = 3
"""points of a fit, at least"""


@dataclass(frozen=True)
class PowerLaw:
    """time = factor * size^exponent, by least squares of the logarithms."""

    exponent: float
    factor: float
    first: float
    """smallest size that was fitted"""
    points: int
    worst: float
    """greatest relative distance of a fitted time to the law"""

    def __call__(self, size: float | int) -> float:
        return self.factor * size**self.exponent


def fit(sizes: Sequence[float | int], times: Sequence[float | int]) -> PowerLaw:
    """The law through all points.

    Raises:
        ValueError: fewer than two sizes, or numbers that have no logarithm.
    """
    x, y = np.asarray(sizes, float), np.asarray(times, float)
    if len(x) != len(y) or len(np.unique(x)) < 2 or not (np.all(x > 0) and np.all(y > 0)):
        raise ValueError(f"a power law needs two sizes and positive numbers, not sizes {sizes} and times {times}")
    exponent, log_factor = np.polyfit(np.log(x), np.log(y), 1)
    factor = float(np.exp(log_factor))
    worst = float(np.max(np.abs(y / (factor * x**exponent) - 1)))
    return PowerLaw(float(exponent), factor, float(x.min()), len(x), worst)


def asymptotic(sizes: Sequence[float | int], times: Sequence[float | int]) -> PowerLaw | None:
    """The law of the asymptotic part: times of at least GROWN times the first, and never fewer than the last FEWEST.

    Sizes increase. None where there are not so many points.
    """
    if len(sizes) < FEWEST:
        return None
    grown = next((i for i, time in enumerate(times) if time >= GROWN * times[0]), len(times))
    first = min(grown, len(times) - FEWEST)
    return fit(sizes[first:], times[first:])
