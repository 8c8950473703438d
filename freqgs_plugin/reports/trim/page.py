"""What trimming did to a run, as tables and JSON."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.timing import environment
from freqgs_plugin.reports.trim.judge import loss
from freqgs_plugin.reports.trim.trimmer import Step

NOTE = (
    "MB: the checkpoint. dB: mean PSNR of the whole scene; lost: the most that it, a prefix of levels or a distance "
    "scale lost against the run as trained. ms: median of 9 pictures of the first training view, all rows taking turns."
)


def place_name(run: Any) -> str:
    """What a page calls the run's tables."""
    data = run.config.data or run.config.pipeline.datamanager.data
    return f"trim {run.config.method_name} {data.name}"


def trim_table(name: str, title: str, steps: Sequence[Step]) -> BenchTable:
    """A row for each step: what is left, what it costs and how long a picture takes."""
    rows = [_row(steps[0], step) for step in steps]

    def decibels(key: str) -> Any:
        return lambda row: "-" if row[key] is None else f"{row[key]:.3f}"

    columns = [
        ("after", lambda row: row["step"]),
        ("Gaussians", lambda row: f"{row['gaussians']:,}"),
        ("MB", lambda row: f"{row['bytes'] / 1e6:.2f}"),
        ("training, dB", decibels("train")),
        ("lost", lambda row: f"{row['loss']:.3f}"),
        ("held out, dB", decibels("test")),
        ("lost", lambda row: "-" if row["test"] is None else f"{row['test_loss']:.3f}"),
        ("ms", lambda row: f"{row['ms']:.1f}"),
    ]
    return BenchTable(name, title, rows, columns, NOTE)


def _row(first: Step, step: Step) -> dict[str, Any]:
    assert step.render is not None
    lost, where = loss(first.train, step.train)
    row: dict[str, Any] = {
        "step": step.name,
        "done": step.done,
        "more": step.more,
        "gaussians": len(step.draft),
        "bytes": step.size,
        "train": list(step.train.values())[-1],
        "loss": lost + 0.0,
        "where": where,
        "test": None,
        "ms": step.render.median_ms,
        "ms_low": step.render.low_ms,
        "ms_high": step.render.high_ms,
        "qualities": {"train": step.train, "test": step.test},
    }
    if step.test is not None and first.test is not None:
        test_loss, test_where = loss(first.test, step.test)
        row.update(test=list(step.test.values())[-1], test_loss=test_loss, test_where=test_where)
    return row


def remarks(steps: Sequence[Step]) -> list[str]:
    """A line for each step: what was left out, and what would have been bought by more."""
    return [f"{s.name}: {s.done or 'nothing'}." + (f" Not done: {s.more}." if s.more else "") for s in steps[1:]]


def summary(steps: Sequence[Step], max_loss: float) -> str:
    """Before and after in a sentence."""
    first, last = steps[0], steps[-1]
    lost, where = loss(first.train, last.train)
    text = (
        f"{first.size / 1e6:.2f} MB became {last.size / 1e6:.2f} MB, {len(first.draft):,} Gaussians "
        f"{len(last.draft):,}. On the training views the largest change is {-lost:+.3f} dB ({where}) of the "
        f"{max_loss:g} dB that may be lost"
    )
    if first.test is None or last.test is None:
        return f"{text}; no view is held out."
    lost, where = loss(first.test, last.test)
    return f"{text}; on held-out views, by which nothing was chosen, {-lost:+.3f} dB ({where})."


def record_of(run: str, method: str, max_loss: float, steps: Sequence[Step]) -> dict[str, Any]:
    """Everything, for trim.json."""
    table = trim_table("", "", steps)
    return {
        **environment(),
        "run": run,
        "method": method,
        "max_loss_db": max_loss,
        "summary": summary(steps, max_loss),
        "steps": [dict(row) for row in table.rows],
        "timing": [None if step.render is None else asdict(step.render) for step in steps],
    }


def markdown(title: str, steps: Sequence[Step], max_loss: float) -> str:
    """Summary, table and remarks."""
    lines = "\n".join(f"* {line}" for line in remarks(steps))
    return f"{summary(steps, max_loss)}\n\n{trim_table('', title, steps).markdown()}\n\n{NOTE}\n\n{lines}\n"
