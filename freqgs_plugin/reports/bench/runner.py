"""Runs one benchmark: threads, progress, and all files at the end, each in one step."""

import io
import json
import os
import shlex
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.page import check_places, fill, read_page, table_text
from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.tables import finite_json
from freqgs_plugin.reports.timing import environment

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

_PROBE = 1 << 20
"""bytes: more than all that a report takes"""
IMAGES = "images"
"""folder beside a documentation page that holds its pictures"""


@dataclass(frozen=True)
class Measured:
    """What a benchmark found."""

    tables: Sequence[BenchTable]
    seeds: dict[str, int] = field(default_factory=dict)
    figure: "Figure | None" = None
    """belongs to the first table"""
    remarks: Sequence[str] = ()
    """lines for the terminal"""


Tick = Callable[[str], object]
"""called when a step begins, with what it is"""


@dataclass(frozen=True)
class Bench:
    """A benchmark."""

    name: str
    tables: Sequence[str]
    """names of the tables that it makes, in order"""
    steps: int
    """how often it calls its `Tick`"""
    measure: Callable[[Tick], Measured]


def run_bench(bench: Bench, options: BenchOptions, console: "Console", *arguments: str) -> Measured:
    """Measure, show, and write NAME.json, NAME.md and, with a figure, NAME.png; fill the page of `options.docs`.

    `arguments` are those of the command line beside the options. Nothing is written before everything is measured.

    Raises:
        BenchError: the page lacks a place, or there are too few threads.
        KeyboardInterrupt: passed on, after a message.
    """
    check_options(options, bench.tables)
    load = _load()
    with use_threads(options.threads):
        start = time.perf_counter()
        measured = _measure(bench, console)
        record: dict[str, Any] = {
            **environment(),
            "command": shlex.join(command_line(bench.name, options, *arguments)),
            "quick": options.quick,
            "rounds": options.rounds,
            "load": load,
            "seeds": measured.seeds,
            "seconds": round(time.perf_counter() - start, 1),
        }
    assert [table.name for table in measured.tables] == list(bench.tables)
    files = _files(bench, measured, record, options)
    write_all(files)
    for table in measured.tables:
        console.print(table.rich())
    for line in (*measured.remarks, *(f"{path}" for path in files)):
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    return measured


def check_options(options: BenchOptions, tables: Sequence[str]) -> None:
    """What can be refused before anything is loaded or measured.

    Raises:
        BenchError: the page lacks the place of one of `tables`.
        OSError: the folder cannot be written.
    """
    if options.docs is not None:
        check_places(read_page(options.docs), tables, options.docs)
    check_folder(options.output_dir)


def command_line(name: str, options: BenchOptions, *arguments: str) -> list[str]:
    """The command that makes the same measurement; without the folders that it writes to."""
    command = ["freqgs", "bench", name, *arguments]
    command += ["--quick"] * options.quick
    for option in ("rounds", "threads"):
        value = getattr(options, option)
        if value != getattr(BenchOptions, option):
            command += [f"--{option}", str(value)]
    return command


def _measure(bench: Bench, console: "Console") -> Measured:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    try:
        with Progress(*columns, console=console, transient=True) as bar:
            task, begun = bar.add_task(bench.name, total=bench.steps), [0]

            def tick(what: str) -> None:
                bar.update(task, description=what, completed=begun[0])
                begun[0] += 1

            measured = bench.measure(tick)
            bar.update(task, completed=bench.steps)
    except KeyboardInterrupt:
        console.print("Stopped. Nothing was written.")
        raise
    assert begun[0] == bench.steps, f"{bench.name} announced {bench.steps} steps and took {begun[0]}"
    return measured


def _files(bench: Bench, measured: Measured, record: dict[str, Any], options: BenchOptions) -> dict[Path, bytes]:
    """Path -> contents of everything that is written."""
    picture = f"{bench.name}.png" if measured.figure is not None else None

    def text(index: int, folder: str) -> str:
        shown = picture if index == 0 else None
        return table_text(measured.tables[index], record, None if shown is None else folder + shown)

    count = range(len(measured.tables))
    report = {**record, "tables": {table.name: table.json() for table in measured.tables}}
    out = options.output_dir
    files = {
        out / f"{bench.name}.json": json.dumps(finite_json(report), indent=1, allow_nan=False).encode() + b"\n",
        out / f"{bench.name}.md": "\n".join(text(i, "") for i in count).encode(),
    }
    if measured.figure is not None:
        files[out / f"{bench.name}.png"] = png(measured.figure)
    if options.docs is not None:
        # it may have been edited meanwhile, or another benchmark has filled its places
        page = read_page(options.docs)
        check_places(page, bench.tables, options.docs)
        for i in count:
            page = fill(page, measured.tables[i].name, text(i, f"{IMAGES}/bench_"))
        files[options.docs] = page.encode()
        if measured.figure is not None:
            files[options.docs.parent / IMAGES / f"bench_{bench.name}.png"] = png(measured.figure)
    return files


def png(figure: "Figure") -> bytes:
    """The figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def check_folder(folder: Path) -> None:
    """Write something there, and leave no trace: what is impossible is better known before hours of work.

    Raises:
        OSError: names the folder.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_PROBE))
            probe.flush()
    except OSError as error:
        raise OSError(error.errno, f"nothing can be written there ({error.strerror})", str(folder)) from error
    for path in missing:
        path.rmdir()


def write_all(files: dict[Path, bytes]) -> None:
    """Write all files beside their names first, then put each into place: no file is ever half-written."""
    parts = {path: path.with_name(path.name + ".part") for path in files}
    try:
        for path, contents in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            parts[path].write_bytes(contents)
        for path, part in parts.items():
            os.replace(part, path)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """torch, the compiled kernels and OpenCV run on `count` threads inside.

    Raises:
        BenchError: numba was started with fewer.
    """
    import cv2
    import numba

    most: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore
    if count > most:
        raise BenchError(f"--threads {count}: numba has {most} here. Choose fewer, or set NUMBA_NUM_THREADS={count}.")
    before = torch.get_num_threads(), numba.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    numba.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])
        cv2.setNumThreads(before[2])


def _load() -> float | None:
    """Processes that wanted to run in the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
