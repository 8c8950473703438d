"""What is streamed."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class StreamScene:
    """Gaussians, how they are drawn, and from where they were seen."""

    gaussians: Gaussians
    background: Float[Tensor, " 3"]
    antialiased: bool
    scene_distance: float | None = None
    """what decay divides distances by, world units; needed where the Gaussians have a decay"""
    cameras: Sequence[Camera] = field(default=())
    """views that decide about the order; without any, opacity times area does"""
    shown: Sequence[tuple[str, Camera]] = field(default=())
    """name and camera of the views that the page offers"""
    rasterizer: str = "auto"
    """draws `cameras`"""
