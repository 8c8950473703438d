"""Filtered scenes, made again only when something has changed."""

import weakref
from collections.abc import Callable, Hashable, Iterable

from torch import Tensor

from freqgs_plugin.apps.filters import apply_filter
from freqgs_plugin.types import Gaussians


class _Seen:
    """A tensor as it was: the object, its memory, and how often it had been written."""

    def __init__(self, tensor: Tensor):
        self._tensor = weakref.ref(tensor)
        self._state = (tensor.data_ptr(), tensor._version)

    def same(self, tensor: Tensor) -> bool:
        return self._tensor() is tensor and self._state == (tensor.data_ptr(), tensor._version)


class FilterCache:
    """The scene of one filter, kept until a parameter is replaced or written."""

    def __init__(self) -> None:
        self._kept: tuple[tuple[Hashable, ...], list[_Seen], Gaussians] | None = None

    def get(
        self, name: str, scene: Callable[[], Gaussians], parameters: Iterable[Tensor], *more: Hashable
    ) -> Gaussians:
        """The filter called `name` of `scene()`, which depends on `parameters` and `more` alone.

        Raises:
            ValueError: as `apply_filter`.
        """
        # one read: several threads draw
        kept, tensors, key = self._kept, list(parameters), (name, *more)
        if kept is not None and kept[0] == key and len(kept[1]) == len(tensors):
            if all(seen.same(tensor) for seen, tensor in zip(kept[1], tensors, strict=True)):
                return kept[2]
        # before the scene is made, so that what is written meanwhile counts as a change
        seen = [_Seen(tensor) for tensor in tensors]
        filtered = apply_filter(scene(), name)
        self._kept = (key, seen, filtered)
        return filtered

    def clear(self) -> None:
        """Give the memory back."""
        self._kept = None
