"""`freqgs report`: trained runs compared by held-out error, what they cost, and whether their numbers are sound."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.page import check_places, fill, read_page
from freqgs_plugin.reports.bench.runner import IMAGES, check_folder, use_threads, write_all
from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.experiments.progress import Bars
from freqgs_plugin.reports.report.circumstances import metadata
from freqgs_plugin.reports.report.folder import RECORD, check_output, write_folder
from freqgs_plugin.reports.report.html_page import html_page
from freqgs_plugin.reports.report.measuring import STAGES, measure_report
from freqgs_plugin.reports.report.options import ReportOptions
from freqgs_plugin.reports.report.page import DOCS_PLOTS, PLACE, docs_part, markdown_page, remarks
from freqgs_plugin.reports.report.plots import COSTS, figures, front_of
from freqgs_plugin.reports.report.runs import open_runs
from freqgs_plugin.reports.report.tables import points_csv, tables, training_csv
from freqgs_plugin.reports.tables import finite_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

PREFIX = "report_"
"""of plots beside a documentation page"""


def run_report(options: ReportOptions, console: "Console") -> dict[str, Any]:
    """Measure, show and write; nothing is written before all of it is measured. Returns the record.

    Raises:
        ReportError: a run that cannot be measured, or runs that cannot be compared.
        BenchError: a documentation page without a place, or too many threads.
        OSError: files that are not there, or an output folder that cannot be used.
        KeyboardInterrupt: passed on, after a message.
    """
    if options.docs is not None:
        check_places(read_page(options.docs), [PLACE], options.docs)
        check_folder(options.docs.parent / IMAGES)
    check_output(options.output_dir)
    files: dict[str, bytes] = {}
    try:
        with use_threads(options.threads):
            with Bars(console, "loading", STAGES) as bars:
                runs, warnings = open_runs(options.load_config, options.names, options.views)
                bars.part("report")
                record, drawn = measure_report(runs, warnings, options, bars)
            shown = tables(record, front_of(record, COSTS["error_time"][2], "rmse"))
            plots = {name: _png(figure, record) for name, figure in figures(record).items()}
            files = _files(record, shown, plots)
            files["report.html"] = html_page(record, shown, plots, drawn).encode()
        write_folder(options.output_dir, files)
        if options.docs is not None:
            _fill_docs(options.docs, record, shown, plots)
    except KeyboardInterrupt:
        # it may have come just after the folder took its place
        written = bool(files) and _holds(options.output_dir / RECORD, files[RECORD])
        what = f"{options.output_dir} is complete, and no more was written." if written else "Nothing was written."
        console.print(f"Stopped. {what}", soft_wrap=True, highlight=False, markup=False)
        raise
    for table in shown:
        console.print(table.rich())
    for line in (*remarks(record), *(str(options.output_dir / name) for name in files)):
        console.print(line.replace("**", ""), soft_wrap=True, highlight=False, markup=False)
    return record


def _holds(path: Path, contents: bytes) -> bool:
    return path.is_file() and path.read_bytes() == contents


def _files(record: Mapping[str, Any], shown: Sequence[BenchTable], plots: Mapping[str, bytes]) -> dict[str, bytes]:
    """Name -> contents of all but the HTML page. The record lists them, so that a later report may replace them."""
    files = {f"{name}.png": contents for name, contents in plots.items()}
    files["report.md"] = markdown_page(record, shown, list(plots)).encode()
    files["report.csv"] = points_csv(record)
    if "error_training" in plots:
        files["training.csv"] = training_csv(record)
    listed = {**record, "files": sorted([*files, "report.html", RECORD])}
    files[RECORD] = json.dumps(finite_json(listed), indent=1, allow_nan=False).encode() + b"\n"
    return files


def _fill_docs(docs: Path, record: Mapping[str, Any], shown: Sequence[BenchTable], plots: Mapping[str, bytes]) -> None:
    taken = [name for name in DOCS_PLOTS if name in plots]
    text = docs_part(record, shown, {name: f"{IMAGES}/{PREFIX}{name}.png" for name in taken})
    folder = docs.parent / IMAGES
    # it may have been edited meanwhile
    page = read_page(docs)
    check_places(page, [PLACE], docs)
    pictures = {folder / f"{PREFIX}{name}.png": plots[name] for name in taken}
    write_all({**pictures, docs: fill(page, PLACE, text).encode()})


def _png(figure: "Figure", record: Mapping[str, Any]) -> bytes:
    """The figure as a PNG file that knows where it comes from."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata=metadata(record))
    return buffer.getvalue()
