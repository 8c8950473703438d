"""A budget as it is typed: Gaussians (`20000`, `20k`), memory (`5MB`) or time (`16ms`)."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from freqgs_plugin.functional.cost import RenderTime, bytes_per_gaussian, count_in_megabytes

Unit = Literal["Gaussians", "MB", "ms"]
_UNITS: dict[str, tuple[Unit, float]] = {
    "": ("Gaussians", 1.0),
    "k": ("Gaussians", 1e3),
    "m": ("Gaussians", 1e6),
    "mb": ("MB", 1.0),
    "gb": ("MB", 1e3),
    "ms": ("ms", 1.0),
    "s": ("ms", 1e3),
}


@dataclass(frozen=True)
class Amount:
    """So much of a unit."""

    value: float | int
    unit: Unit

    def count(self, sh_degree: int, decay: bool, pixels: int, measure: Callable[[], RenderTime]) -> int:
        """How many Gaussians it allows in a picture of `pixels`; `measure` is asked only for a budget of time.

        Memory is that of float32 parameters.

        Raises:
            ValueError: not one Gaussian fits.
        """
        if self.unit == "Gaussians":
            return math.floor(self.value)
        if self.unit == "MB":
            return count_in_megabytes(self.value, bytes_per_gaussian("memory", sh_degree, decay))
        return measure().count(self.value, pixels)

    def __str__(self) -> str:
        return f"{self.value:,.0f} Gaussians" if self.unit == "Gaussians" else f"{self.value:g} {self.unit}"


def parse_amount(text: str) -> Amount:
    """Read `20000`, `20k`, `1.5M`, `5MB`, `16ms`; capitals do not matter.

    Raises:
        ValueError: another form, or less than 1 Gaussian, or not above 0 MB or ms.
    """
    found = re.fullmatch(r"\s*([\d_]*\.?\d+)\s*([a-z]*)\s*", text.lower())
    if found is None or found[2] not in _UNITS:
        raise ValueError(f"budget is '{text}'; give Gaussians (20000 or 20k), memory (5MB) or time (16ms).")
    unit, factor = _UNITS[found[2]]
    amount = Amount(float(found[1].replace("_", "")) * factor, unit)
    if amount.value < (1 if unit == "Gaussians" else 1e-300):
        raise ValueError(f"budget is '{text}'; it must allow at least one Gaussian.")
    return amount
