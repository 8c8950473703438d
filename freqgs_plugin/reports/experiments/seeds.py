"""Figures of runs that differ in their seed alone: mean and spread."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spread:
    """Of one figure over all seeds."""

    mean: float
    half_range: float
    """half of the distance between the smallest and the largest"""
    count: int

    def text(self, form: str = ".2f") -> str:
        """Mean and, of more than one seed, half of the range behind ±."""
        if self.count == 1:
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} ± {self.half_range:{form.lstrip('+')}}"


def spread(results: Sequence[Any], figure: Callable[[Any], float | int | None]) -> Spread | None:
    """`figure` of every seed's result; None where one has none."""
    values = [figure(result) for result in results]
    known = [float(value) for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    return Spread(statistics.fmean(known), (max(known) - min(known)) / 2, len(known))


def mean(results: Sequence[Any], figure: Callable[[Any], float | int | None]) -> float:
    """Over all seeds; NaN where one has none."""
    found = spread(results, figure)
    return float("nan") if found is None else found.mean


def shown(results: Sequence[Any], figure: Callable[[Any], float | int | None], form: str = ".2f") -> str:
    """`figure` for a table; a dash where there is none."""
    found = spread(results, figure)
    return "-" if found is None else found.text(form)
