"""The Markdown page of a report, and its part for a documentation page."""

from collections.abc import Mapping, Sequence
from typing import Any

from freqgs_plugin.reports.bench.tables import BenchTable, without_html
from freqgs_plugin.reports.report.circumstances import sentence

PLACE = "report"
"""of a report in a documentation page"""
DOCS_PLOTS = ("error_time", "error_training")
"""plots that a documentation page shows"""
_CAPTIONS = {
    "error_time": "Held-out error against render time. Bars: quartiles of the time",
    "error_bytes": "Held-out error against bytes",
    "error_count": "Held-out error against the number of Gaussians",
    "error_training": "Held-out error against training time",
}
_MARKED = "Black rings: the Pareto front, that is no other point is both cheaper and better."


def caption(plot: str) -> str:
    """What a plot shows."""
    return _CAPTIONS[plot] + ("." if plot == "error_training" else ". " + _MARKED)


def remarks(record: Mapping[str, Any]) -> list[str]:
    """Warnings, what is not there and why, and what went wrong in training."""
    found = [f"**{warning}**" for warning in record["warnings"]]
    for run in record["runs"]:
        if run["training"]["missing"]:
            found.append(f"No error against training time for {run['name']}: it {run['training']['missing']}.")
        stopped, seconds = run["training"]["pauses"]
        if stopped:
            found.append(
                f"{stopped} step{'s' if stopped > 1 else ''} of {run['name']} took over 100 times the median, "
                f"{seconds:,.0f} s in all: the trainer was stopped, or compiled its kernels. That is not counted as "
                "training."
            )
        if what := run["health"]["training"]["what"]:
            found.append(f"First value of {run['name']} that was not finite: {what}.")
    return found


def markdown_page(record: Mapping[str, Any], tables: Sequence[BenchTable], plots: Sequence[str]) -> str:
    """The whole page; plots lie beside it."""
    parts = ["# Report", *body(record, tables, {name: f"{name}.png" for name in plots}, "##")]
    return "\n\n".join(parts) + "\n"


def docs_part(record: Mapping[str, Any], tables: Sequence[BenchTable], plots: Mapping[str, str]) -> str:
    """What goes between the comments of a documentation page; `plots`: name -> path seen from there."""
    return "\n\n".join(body(record, tables, plots, "###")) + "\n"


def body(record: Mapping[str, Any], tables: Sequence[BenchTable], plots: Mapping[str, str], heading: str) -> list[str]:
    """Circumstances, remarks, plots and tables."""
    parts = [without_html(sentence(record))]
    if found := remarks(record):
        parts.append("\n".join(f"* {without_html(line)}" for line in found))
    for name, path in plots.items():
        parts += [f"![{_CAPTIONS[name]}]({path})", caption(name)]
    for table in tables:
        parts += [f"{heading} {table.title}", table.markdown(), table.note]
    return [part for part in parts if part]
