"""Progress of an experiment on the terminal: what is done in all, and the step that runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rich.console import Console


@runtime_checkable
class Progress(Protocol):
    """Shows tasks."""

    def task(self, title: str, total: int | None) -> "AbstractContextManager[Callable[[int], object]]":
        """A step of `total` parts (None: nobody knows); the function that is handed out takes how many are done."""
        ...


class Silent:
    """Shows nothing."""

    @contextmanager
    def task(self, title: str, total: int | None) -> Iterator[Callable[[int], object]]:
        yield lambda done: None


class Bars:
    """Bars of rich; what is done of the whole experiment on the first one."""

    def __init__(self, console: "Console", title: str, total: int) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
        # loading a run sends what nerfstudio prints to a log; rich must not take it from there
        self._bars = Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
        self._whole = self._bars.add_task(title, total=total)

    def __enter__(self) -> "Bars":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def part(self, title: str) -> None:
        """The part of the whole called `title` begins."""
        self._bars.update(self._whole, description=title)

    def advance(self) -> None:
        """A part of the whole is finished."""
        self._bars.advance(self._whole)

    @contextmanager
    def task(self, title: str, total: int | None) -> Iterator[Callable[[int], object]]:
        task = self._bars.add_task(title, total=total)
        try:
            yield lambda done: self._bars.update(task, completed=done)
        finally:
            self._bars.remove_task(task)
