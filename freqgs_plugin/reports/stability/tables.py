"""The rows as tables: one line per case, one cell per backend and dtype with errors and time side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.stability.case import Row
from freqgs_plugin.reports.stability.cases_training import EVENT, SIZE, STEPS, WINDOW

if TYPE_CHECKING:
    from rich.table import Table

INTRODUCTION = """# Stability

What happens at the extremes: every case is put to every backend and dtype, and has one outcome that is right. This
page is written by `freqgs stability --output-dir docs`; its JSON is [stability.json](stability.json). The same table of
cases drives the tests.

A cell holds value error, gradient error and time (forward and backward, kernels compiled before):

* *value error*: the greatest error of any output (features, alpha, depth; the value of a loss), relative to the
  output's largest magnitude, or to 1 if that is larger.
* *gradient error*: of a fixed random functional of the outputs, for each input as the norm of the difference over the
  norm of the truth, in natural units (per pixel of displacement, per relative change of scale, per radian of rotation,
  per unit of opacity and of feature). The worst input counts. A gradient under 1/1000 of the largest one counts as
  1/1000.
* the *truth* is an evaluation in float64 of its own: every Gaussian at every pixel by plain autograd, from a factor of
  the covariance; losses by matrices and windows. For pictures too large for that, torch in float64. Inputs are rounded
  to float32 first, so that all see the same numbers.
* the *expected* outcome is `value` (finite, and within the dtype's tolerance), `zero` (exactly what an empty scene
  gives, and gradients that are exactly zero) or a named error. At a kink (a magnitude or a difference of 0) the
  gradient is right if it is bounded.
* a case *on a threshold* (alpha 1/255, the cap 0.999, transmittance 1e-4, the near plane) has two right answers, one
  for each side; a picture may agree with either, pixel by pixel.
"""

NOTES = {
    "training": f"""
`lapsplat` on 20 ray-traced photographs of {SIZE[0]}x{SIZE[1]} px, 15 to train on, {STEPS} steps, growth up to 4,000
Gaussians. *RMSE* is of the held-out pictures, colours in [0, 1]; *flat* is that of flat pictures in the
photographs' mean colour, and a run that is no better has diverged. Losses are means over {WINDOW} steps; *back after*
counts the steps from the event (at step {EVENT}) until the loss is within 10 % of what it was before.
""",
}

HEADINGS = {
    "geometry": "Geometry",
    "compositing": "Opacity and colour",
    "decay": "Distance decay",
    "losses": "Losses and pyramids",
    "autocast": "Half precision around it",
    "training": "Training",
}


def markdown_page(groups: Mapping[str, Any]) -> str:
    """docs/stability.md, from the groups of the JSON file."""
    parts = [INTRODUCTION]
    for name, record in groups.items():
        rows = [Row(**{f.name: row[f.name] for f in fields(Row) if f.name in row}) for row in record["rows"]]
        failed = sum(not row.passed for row in rows)
        hardware, settings = record["hardware"], _settings(rows)
        lines = [
            f"## {HEADINGS[name]}\n",
            f"{len(rows)} outcomes, {failed or 'none'} of them not as expected. {record['date'][:10]}, commit "
            f"{record['commit']}, {hardware['processor']}, threads: {hardware['threads']}, "
            f"{hardware['gpu'] or 'no GPU'}, torch {record['versions']['torch']}, {record['seconds']:.0f} s in all.\n",
            *([NOTES[name].lstrip()] if name in NOTES else []),
            "| case | expected | " + " | ".join(f"{b} {d}" for b, d in settings) + " |",
            "| --- " * (2 + len(settings)) + "|",
        ]
        for case, of_case in _by_case(rows).items():
            cells = [cell(of_case[s]) if s in of_case else "" for s in settings]
            lines.append("| " + " | ".join([case, next(iter(of_case.values())).expected, *cells]) + " |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def rich_table(group: str, rows: Sequence[Row]) -> "Table":
    """The same for a terminal."""
    from rich.table import Table

    settings = _settings(rows)
    table = Table(title=f"{HEADINGS[group]}: value error, gradient error, time")
    for heading in ("case", "expected", *(f"{b} {d}" for b, d in settings)):
        table.add_column(heading)
    for case, of_case in _by_case(rows).items():
        expected = next(iter(of_case.values())).expected
        right = all(row.passed for row in of_case.values())
        cells = (cell(of_case[s]) if s in of_case else "" for s in settings)
        table.add_row(case, expected, *cells, style=None if right else "bold red")
    return table


def cell(row: Row) -> str:
    """Errors beside time; what went wrong in front of them."""
    parts = []
    if not row.passed or row.outcome not in ("value", "zero"):
        parts.append(row.outcome.partition(":")[0] if row.passed else f"**wrong**: {row.outcome}")
    elif row.outcome == "zero":
        parts.append("zero")
    if row.value_error is not None and row.outcome != "zero" and not row.note:
        parts += [f"{row.value_error:.0e}", "-" if row.gradient_error is None else f"{row.gradient_error:.0e}"]
    if row.milliseconds is not None:
        parts.append(f"{row.milliseconds:,.1f} ms" if row.milliseconds < 1000 else f"{row.milliseconds / 1000:,.1f} s")
    return ", ".join([*parts, *([row.note] if row.note else [])]).replace("|", "/")


def _settings(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row.backend, row.dtype) for row in rows))


def _by_case(rows: Sequence[Row]) -> dict[str, dict[tuple[str, str], Row]]:
    table: dict[str, dict[tuple[str, str], Row]] = {}
    for row in rows:
        table.setdefault(row.case, {})[row.backend, row.dtype] = row
    return table
