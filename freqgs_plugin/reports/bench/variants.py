"""The torch rasterizer with other constants, for the length of a block: what each approximation changes."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from freqgs_plugin.functional import projection
from freqgs_plugin.rendering import torch_backend, torch_compositing, torch_tiles
from freqgs_plugin.rendering.base import ALPHA_MIN, RADIUS_SIGMAS, TRANSMITTANCE_MIN

NO_THRESHOLD = 1e-12
"""an alpha below this is nothing in float64: a Gaussian ends at 7.4 standard deviations"""
NO_STOP = 1e-30
"""a transmittance that no pixel reaches"""
NO_CULLING = 12.0
"""standard deviations outside of the image at which a Gaussian is left out: far beyond NO_THRESHOLD"""


@dataclass(frozen=True)
class Constants:
    """What the compositors approximate with."""

    alpha_min: float = ALPHA_MIN
    stop: float = TRANSMITTANCE_MIN
    radius_sigmas: float = RADIUS_SIGMAS
    tile: int = torch_tiles.TILE
    """side, px"""


EXACT = Constants(NO_THRESHOLD, NO_STOP, NO_CULLING)
"""the sum over all Gaussians at all pixels, to 12 digits"""


@contextmanager
def constants(chosen: Constants) -> Iterator[None]:
    """The torch rasterizer composites with `chosen` inside: forward and backward must both run in the block."""
    values = {
        "ALPHA_MIN": chosen.alpha_min,
        "TRANSMITTANCE_MIN": chosen.stop,
        "RADIUS_SIGMAS": chosen.radius_sigmas,
        "TILE": chosen.tile,
        "PIXELS": chosen.tile**2,
    }
    before = [
        (module, name, getattr(module, name))
        for module in (projection, torch_backend, torch_compositing, torch_tiles)
        for name in values
        if hasattr(module, name)
    ]
    try:
        for module, name, _ in before:
            setattr(module, name, values[name])
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)
