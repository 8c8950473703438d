"""Named outputs that are rendered only when somebody reads them."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch


class LazyOutputs(dict[str, Any]):
    """A dict of outputs; a value given as a function is computed when it is first read, without gradients.

    The viewer lists all names and reads one. ns-render reads those it was asked for.
    """

    def __init__(
        self,
        ready: Mapping[str, Any],
        later: Mapping[str, Callable[[], Any]],
        notes: dict[str, float] | None = None,
    ):
        super().__init__({**ready, **dict.fromkeys(later)})
        self._later = dict(later)
        self.notes = {} if notes is None else notes
        """numbers that outputs leave when they are computed"""

    def __getitem__(self, name: str) -> Any:
        if name in self._later:
            with torch.no_grad():
                self[name] = self._later[name]()
        return super().__getitem__(name)

    def __setitem__(self, name: str, value: Any) -> None:
        self._later.pop(name, None)
        super().__setitem__(name, value)

    def __iter__(self) -> Iterator[str]:
        # without this, dict(outputs) and {**outputs} copy what is stored and skip __getitem__
        return super().__iter__()

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    def items(self) -> Iterator[tuple[str, Any]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return ((name, self[name]) for name in list(self))

    def values(self) -> Iterator[Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return (self[name] for name in list(self))
