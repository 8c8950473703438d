"""What a run leaves out that its scene does not need, and what more would have bought: as its log and trimming said."""

import json
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.report.options import ReportError
from freqgs_plugin.training.choose_levels import said_of_levels

TRIMMED = "trim.json"
"""what `freqgs trim` leaves in the folder of a run that it wrote"""


def left_out(choice: dict[str, Any], folder: Path) -> list[dict[str, str]]:
    """Rows of `what`, `done` and `more` (empty where nothing was said).

    Args:
        choice: how the number of levels was chosen, from the checkpoint; empty where it was given.
        folder: of the run.

    Raises:
        ReportError: its trim.json is damaged.
    """
    rows = [_row("levels", text) for text in said_of_levels(choice)]
    file = folder / TRIMMED
    if file.is_file():
        rows += _trimmed(file)
    return rows


def _trimmed(file: Path) -> list[dict[str, str]]:
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        steps = [_row(step["step"], step["done"] or "nothing", step["more"]) for step in record["steps"][1:]]
        return [_row("trimmed", record["summary"]), *steps]
    except (ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{file} is damaged ({error!r}): remove it, and the report goes without it.") from error


def _row(what: str, done: str, more: str | None = "") -> dict[str, str]:
    return {"what": what, "done": done, "more": more or ""}
