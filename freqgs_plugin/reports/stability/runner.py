"""`freqgs stability`: runs the groups, saves each row at once and each finished group as JSON and Markdown."""

import json
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.reports.stability.case import Case, Group, Refused, Row, Setting, StabilityError
from freqgs_plugin.reports.stability.cases_training import TrainingCase, run_training
from freqgs_plugin.reports.stability.measure import Evaluated, measure, truths
from freqgs_plugin.reports.stability.suite import GROUPS, cases_of
from freqgs_plugin.reports.stability.tables import markdown_page, rich_table
from freqgs_plugin.reports.tables import finite_json
from freqgs_plugin.reports.timing import environment

if TYPE_CHECKING:
    from rich.console import Console

JSON, PAGE, ROWS = "stability.json", "stability.md", "stability-rows.jsonl"


def run_stability(output_dir: Path, only: Group | None, quick: bool, console: "Console") -> None:
    """Run the groups (or `only` one) and write `stability.json` and `stability.md`; groups that were not run stay.

    Raises:
        StabilityError: some outcome was not the expected one.
        KeyboardInterrupt: passed on, after a message on what is saved.
    """
    check_folder(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    saved_groups(output_dir)
    rows_path = output_dir / ROWS
    rows_path.unlink(missing_ok=True)
    failed: list[Row] = []
    for group in GROUPS if only is None else (only,):
        cases = cases_of(group, quick)
        if not cases:
            console.print(f"Left out, as all of it takes long: {group}.")
            continue
        with _told(group, output_dir, only, quick, console):
            rows, seconds = _run_group(group, cases, rows_path, console)
        record = {**environment(), "quick": quick, "seconds": round(seconds, 1), "rows": [asdict(row) for row in rows]}
        save_group(output_dir, group, record)
        console.print(rich_table(group, rows))
        failed += [row for row in rows if not row.passed]
    rows_path.unlink(missing_ok=True)
    for name, what in ((JSON, "all rows, with hardware and versions"), (PAGE, "the same as tables")):
        console.print(f"{output_dir / name}: {what}", soft_wrap=True, highlight=False, markup=False)
    if failed:
        names = "; ".join(f"{row.group}: {row.case} ({row.backend} {row.dtype}: {row.outcome})" for row in failed)
        raise StabilityError(f"{len(failed)} outcomes are not the expected ones: {names}")


def saved_groups(output_dir: Path) -> dict[str, Any]:
    """The groups in the JSON file; none where there is no file.

    Raises:
        StabilityError: it is damaged.
    """
    path = output_dir / JSON
    if not path.is_file():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["groups"])
    except (ValueError, KeyError, TypeError) as error:
        raise StabilityError(f"{path} is damaged ({error!r}); move it away, or choose another --output-dir") from error


def save_group(output_dir: Path, group: Group, record: dict[str, Any]) -> None:
    """Put a finished group into the JSON file and write the page anew, each in one step."""
    path, groups = output_dir / JSON, saved_groups(output_dir)
    groups[group] = finite_json(record)
    groups = {name: groups[name] for name in GROUPS if name in groups}
    text, page = json.dumps({"groups": groups}, indent=1, allow_nan=False) + "\n", markdown_page(groups)
    _replace(path, text)
    _replace(output_dir / PAGE, page)


def _run_group(
    group: Group, cases: Sequence[Case | TrainingCase], rows_path: Path, console: "Console"
) -> tuple[list[Row], float]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    start, rows = time.perf_counter(), []
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console) as bar, rows_path.open("a", encoding="utf-8") as file:
        task = bar.add_task(group, total=len(cases))
        outcomes = _outcomes(cases)
        for case in cases:
            bar.update(task, description=case.id)
            for row in next(outcomes):
                rows.append(row)
                file.write(json.dumps(finite_json(asdict(row))) + "\n")
            file.flush()
            bar.advance(task)
        bar.update(task, description=group)
    return rows, time.perf_counter() - start


def _outcomes(cases: Sequence[Case | TrainingCase]) -> Iterator[list[Row]]:
    """The rows of each case. Training runs share a child process, and run with what `auto` would choose."""
    training = [case for case in cases if isinstance(case, TrainingCase)]
    runs = run_training(training, Setting("gsplat" if torch.cuda.is_available() else "numba", torch.float32))
    for case in cases:
        yield [next(runs)] if isinstance(case, TrainingCase) else _run_case(case)


def _run_case(case: Case) -> list[Row]:
    answers: Sequence[Evaluated] = [] if isinstance(case.expected, Refused) else truths(case)
    return [measure(case, setting, answers, repeats=1 if case.large else 3) for setting in case.settings]


@contextmanager
def _told(group: Group, output_dir: Path, only: Group | None, quick: bool, console: "Console") -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        console.print(
            f"Stopped in group {group}. Its rows so far are in {output_dir / ROWS}, until the next start; "
            f"{output_dir / JSON} holds whole groups only. To go on:",
            soft_wrap=True, highlight=False, markup=False,
        )  # fmt: skip
        for name in (only,) if only is not None else GROUPS[GROUPS.index(group) :]:
            command = ["freqgs", "stability", "--output-dir", str(output_dir), "--only", name, *["--quick"] * quick]
            console.print(f"  {shlex.join(command)}", soft_wrap=True, highlight=False, markup=False)
        raise


def _replace(path: Path, text: str) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
