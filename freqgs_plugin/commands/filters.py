"""`freqgs filters`: a contact sheet of filters from several views."""

import os
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from freqgs_plugin.apps.filters import Filter
from freqgs_plugin.apps.own_filters import filter_label, find_filter
from freqgs_plugin.commands.options import CommandError, FilterOptions
from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.reports.bench.tables import number
from freqgs_plugin.reports.bench.trained import load, views_of_split
from freqgs_plugin.reports.contact_sheet import write_sheet
from freqgs_plugin.reports.filters import FilterRow, draw_filters, spread

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def run_filters(options: FilterOptions, console: "Console") -> None:
    """Write the sheet, and print what each filter changes and how far it is the same from a step aside.

    Raises:
        CommandError: no such filter or run, too few views, or a filter that this scene does not allow.
        OSError: a file that is not there, or cannot be written.
    """
    from rich.progress import Progress

    output = options.output
    if output.suffix.lower() != ".png":
        raise CommandError(f"--output is {output}; give it the ending .png.")
    if options.views < 1:
        raise CommandError(f"--views is {options.views}; it must be at least 1.")
    partial = output.with_name(f".{output.name}")
    try:
        filters = _found(options.filters)
        check_folder(output.parent)
        run = load(options.load_config)
        views = _views(run, options.views)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("Drawing", total=len(filters) + 1)
            rows, sheet = draw_filters(run, views, filters, lambda: bar.advance(task))
        output.parent.mkdir(parents=True, exist_ok=True)
        write_sheet(partial, sheet)
        os.replace(partial, output)
    except ValueError as error:
        raise CommandError(str(error)) from error
    finally:
        partial.unlink(missing_ok=True)
    console.print(_table(rows, len(views)))
    console.print(str(output), soft_wrap=True, highlight=False, markup=False)


def _found(texts: Sequence[str]) -> dict[str, Filter]:
    """By label, or where several have the same, by all that was typed."""
    labels = {text: filter_label(text) for text in texts}
    often = Counter(labels.values())
    return {label if often[label] == 1 else text: find_filter(text) for text, label in labels.items()}


def _views(run: Any, wanted: int) -> list[Any]:
    """Evenly of those held out, or where these are too few, of all."""
    views = views_of_split(run, "test")
    if len(views) < wanted:
        views = sorted([*views, *views_of_split(run, "train")], key=lambda view: view.name)
    if len(views) < wanted:
        raise ValueError(f"--views is {wanted}, and the run has {len(views)} views; ask for fewer.")
    return [views[i] for i in spread(len(views), wanted)]


def _table(rows: list[FilterRow], views: int) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"Filters, {views} views")
    for heading in ("filter", "Gaussians", "changed, RMSE", "step aside, RMSE", "seen in both"):
        table.add_column(heading, justify="left" if heading == "filter" else "right")
    for row in rows:
        changed, aside = number(row.changed), number(row.step_aside)
        table.add_row(escape(row.name), f"{row.gaussians:,}", changed, aside, f"{row.shared:.0%}")
    return table
