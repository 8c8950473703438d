"""A measured table: the same cells for the terminal, for Markdown and, as raw numbers, for JSON."""

import html
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.timing import Timing

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]
Column = tuple[str, Callable[[Row], str]]
"""heading, and the text of a row's cell"""


@dataclass(frozen=True)
class BenchTable:
    """Rows of raw numbers, and how they are shown."""

    name: str
    """marks the table's place in a page"""
    title: str
    rows: Sequence[Row]
    columns: Sequence[Column]
    note: str = ""
    """what one must know to read it; Markdown"""

    def cells(self) -> list[list[str]]:
        return [[text(row) for _, text in self.columns] for row in self.rows]

    def markdown(self) -> str:
        """The table alone; numbers are aligned to the right."""
        cells = self.cells()
        align = ["---" if i == 0 else "---:" for i in range(len(self.columns))]
        lines = [[heading for heading, _ in self.columns], align, *cells]
        return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)

    def rich(self) -> "Table":
        """The table for a terminal."""
        from rich.markup import escape
        from rich.table import Table

        table = Table(title=escape(self.title))
        for i, (heading, _) in enumerate(self.columns):
            table.add_column(heading, justify="left" if i == 0 else "right")
        for line in self.cells():
            table.add_row(*(escape(cell) for cell in line))
        return table

    def json(self) -> dict[str, Any]:
        """Title, note and rows, with dataclasses as dictionaries."""
        return {"title": self.title, "note": self.note, "rows": [_plain(row) for row in self.rows]}


def without_html(text: str) -> str:
    """Markdown in which a `<` is shown, not obeyed (a run's name may hold anything); code is left as it is."""
    return re.sub(r"(`[^`]*`)|([&<])", lambda found: found[1] or html.escape(found[2]), text)


def _cell(text: str) -> str:
    """Neither ends the cell nor the line."""
    return without_html(" ".join(text.splitlines())).replace("|", "\\|")


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def milliseconds(timing: Timing | None) -> str:
    """Median and quartiles, ms, with about three digits; a dash where nothing was measured."""
    if timing is None:
        return "-"
    return f"{number(timing.median_ms)} ({number(timing.low_ms)}-{number(timing.high_ms)})"


def number(value: float | int | None) -> str:
    """Three digits, without an exponent between 0.001 and a million."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    if not 0.001 <= abs(value) < 1e6:
        return f"{value:.1e}"
    if abs(value) < 1:
        return f"{value:.3g}"
    digits = 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f"{value:,.{digits}f}"


def ratio(timing: Timing | None, reference: Timing | None) -> float | None:
    """Quotient of medians."""
    return None if timing is None or reference is None else timing.median_ms / reference.median_ms
