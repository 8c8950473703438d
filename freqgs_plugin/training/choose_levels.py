"""How many levels a scene needs: by the energy of its photographs' Laplacian bands."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.pyramid import laplacian, max_levels

MOST_LEVELS = 5
"""the more of the paper's two settings"""


@dataclass(frozen=True)
class LevelChoice:
    """What was measured, and how many levels follow from it."""

    levels: int
    """1 and one more for each band that is kept"""
    energies: list[float]
    """mean square of each band above the base, coarse to fine; colours in [0, 1], mean over pixels of the band"""
    kept: list[bool]
    """which of them hold their share"""
    bound: float
    """the mean square that a band must hold"""
    size: tuple[int, int]
    """width and height of the smallest photograph, px"""

    def text(self) -> str:
        """What was kept and what was dropped, and why."""
        octaves = [2**n for n in range(len(self.energies), 0, -1)]
        told = ", ".join(
            f"{'kept' if keep else 'dropped'} 1/{octave // 2 or 1} size: {energy:.2e}"
            for octave, energy, keep in zip(octaves, self.energies, self.kept, strict=True)
        )
        most = len(self.energies) + 1
        width, height = self.size
        limit = f"at most {most}, since images of {width}x{height} px would otherwise be trained at under 16 px"
        if most == MOST_LEVELS:
            limit = f"at most {most}"
        bands = f"mean square of each Laplacian band, needed {self.bound:.2e}: {told}" if told else "no band to measure"
        return f"{self.levels} level{'s' if self.levels > 1 else ''} ({limit}). {bands}."

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "LevelChoice":
        """What `state` was made of; other keys are passed over."""
        width, height = state["size"]
        return cls(state["levels"], state["energies"], state["kept"], state["bound"], (width, height))

    def state(self) -> dict[str, Any]:
        """For a checkpoint: numbers, lists and text alone."""
        return {
            "levels": self.levels,
            "energies": self.energies,
            "kept": self.kept,
            "bound": self.bound,
            "size": list(self.size),
        }


def said_of_levels(choice: Mapping[str, Any]) -> list[str]:
    """What a run's log said on its number of levels, from `level_choice` in its checkpoint; none where it was given."""
    said = [LevelChoice.from_state(choice).text()] if "levels" in choice else []
    return [*said, *([choice["stopped"]] if "stopped" in choice else [])]


def choose_levels(images: Iterable[Float[Tensor, "_ _ 3"]], psnr: float | int, share: float | int) -> LevelChoice:
    """As many levels as there are bands that matter, at most 5, the coarsest image at 16 px or more.

    A scene trained to a PSNR of `psnr` dB has a mean square error of 10^(-psnr / 10). A band that holds less than
    `share` of that could be missing without being missed, and gets no level. Colours are in [0, 1].

    Raises:
        ValueError: no images, or a share or PSNR that is not a number >= 0.
    """
    if not 0 <= share < float("inf") or not 0 <= psnr < float("inf"):
        raise ValueError(f"the share {share} and the PSNR {psnr} must be finite numbers >= 0.")
    sums: Tensor | None = None
    count, smallest = 0, (0, 0)
    # sizes may differ: the smallest one decides how many bands there are
    for image in images:
        height, width = image.shape[:2]
        bands = laplacian(image.permute(2, 0, 1)[None], min(max_levels(height, width), MOST_LEVELS))[1:]
        # fine to coarse, so that what all have in common comes first
        energies = torch.tensor([float(band.double().square().mean()) for band in reversed(bands)], dtype=torch.float64)
        if sums is None or len(energies) < len(sums):
            sums = energies if sums is None else sums[: len(energies)] + energies
            smallest = (width, height)
        else:
            sums = sums + energies[: len(sums)]
            smallest = min(smallest, (width, height), key=min)
        count += 1
    if sums is None:
        raise ValueError("there are no images to choose levels by.")
    bound = share * 10 ** (-psnr / 10)
    means = (sums / count).flip(0).tolist()
    kept = [energy >= bound for energy in means]
    return LevelChoice(1 + sum(kept), means, kept, bound, smallest)
