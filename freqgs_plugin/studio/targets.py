"""What a training view is compared with, kept from step to step while it stays the same."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from freqgs_plugin.training.objective import PyramidTargets


@dataclass(frozen=True)
class ViewTarget:
    """One view's image and mask at the stage's size, and their pyramid."""

    image: Tensor
    """[h, w, 3]; without a mask it shares memory with the pyramid: planes, as rendered pictures are"""
    mask: Tensor | None
    pyramid: PyramidTargets

    def megabytes(self) -> float:
        parts = [self.mask, self.pyramid.magnitudes, *self.pyramid.reduced]
        if self.mask is not None:
            parts.append(self.image)
        return sum(p.numel() * p.element_size() for p in parts if p is not None) / 2**20


class TargetCache:
    """Targets by view, up to a bound on memory."""

    def __init__(self, megabytes: float | int):
        self._bound = megabytes
        self._used = 0.0
        self._kept: dict[Hashable, ViewTarget] = {}

    def clear(self) -> None:
        self._kept.clear()
        self._used = 0.0

    def get(
        self, key: Hashable | None, make: Callable[[], tuple[Tensor, Tensor | None]], levels: int, **options: Any
    ) -> ViewTarget:
        """The target under `key`, or made by `make` (image [h, w, 3], mask [h, w, 1]); `key` None: not kept.

        `options` are those of `PyramidTargets.from_image`.
        """
        if key is not None and key in self._kept:
            return self._kept[key]
        image, mask = make()
        pyramid = PyramidTargets.from_image(image, levels, mask, **options)
        if mask is None:
            image = pyramid.reduced[-1][0].permute(1, 2, 0)
        target = ViewTarget(image, mask, pyramid)
        if key is not None and self._used + target.megabytes() <= self._bound:
            self._kept[key] = target
            self._used += target.megabytes()
        return target
