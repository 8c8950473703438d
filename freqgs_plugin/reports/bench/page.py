"""The Markdown of a benchmark, and the places in a documentation page that it fills."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.reports.bench.tables import BenchTable


def place(name: str) -> tuple[str, str]:
    """The comments around the table `name` in a page."""
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def read_page(path: Path) -> str:
    """A page of Markdown; empty where there is none.

    Raises:
        BenchError: it is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8") if path.is_file() else ""
    except UnicodeDecodeError as error:
        raise BenchError(f"{path} is not text in UTF-8 ({error}); name a page of Markdown, or save it as UTF-8.") from (
            error
        )


def check_places(page: str, names: Sequence[str], path: object) -> None:
    """Refuse a page that lacks a place, before anything is measured.

    Raises:
        BenchError: with the lines to add.
    """
    for name in names:
        begin, end = place(name)
        if page.count(begin) != 1 or page.count(end) != 1 or page.index(begin) > page.index(end):
            raise BenchError(
                f"{path} has no one place for the table '{name}'. Add the two lines '{begin}' and '{end}' to it, in "
                "this order, once."
            )


def fill(page: str, name: str, text: str) -> str:
    """The page with `text` between the comments of the place `name`."""
    begin, end = place(name)
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    return pattern.sub(lambda _: f"{begin}\n{text}\n{end}", page, count=1)


def table_text(table: BenchTable, record: dict[str, Any], picture: str | None = None) -> str:
    """Caption, table, note and, where there is one, the picture at `picture`."""
    parts = [f"*{table.title}.* {circumstances(record)}", table.markdown()]
    if table.note:
        parts.append(table.note)
    if picture is not None:
        parts.append(f"![{table.title}]({picture})")
    return "\n\n".join(parts) + "\n"


def circumstances(record: dict[str, Any]) -> str:
    """When, where and how, in one line."""
    hardware, versions = record["hardware"], record["versions"]
    threads = hardware["threads"]
    parts = [
        record["date"][:10],
        f"commit {record['commit']}",
        f"{hardware['processor']}, {hardware['cores']} cores, {threads} thread{'s' if threads > 1 else ''} used",
        hardware["gpu"] or "no GPU",
        f"torch {versions['torch']}",
        f"numba {versions['numba']}",
        f"load before the start {record['load']}",
        f"`{record['command']}`",
    ]
    return ", ".join(parts) + "." + (" **Small sizes (`--quick`): not for comparison.**" if record["quick"] else "")
