"""`freqgs report`, with tables as wide as they are."""

import sys

from rich.console import Console

from freqgs_plugin.reports.report.options import ReportOptions
from freqgs_plugin.reports.report.runner import run_report


def report_on(options: ReportOptions) -> None:
    """Measure, show and write; see `run_report` for what it raises."""
    # loading runs is done with the standard output put aside
    run_report(options, Console(file=sys.stdout) if sys.stdout.isatty() else Console(file=sys.stdout, width=240))
