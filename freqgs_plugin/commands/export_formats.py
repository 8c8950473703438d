"""One function per format: it writes into a folder, reads back what it wrote, and tells what that loses."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from freqgs_plugin.commands.export_loss import Loss, Written, measure_loss
from freqgs_plugin.commands.export_options import ExportOptions
from freqgs_plugin.commands.export_plain import Plain, check_plain, plain
from freqgs_plugin.commands.export_source import Source, select
from freqgs_plugin.commands.export_streams import FOLDER, PAGE, check_stream, write_as_html, write_as_stream
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.ply import SplatFileError, write_ply
from freqgs_plugin.io.splat_transform import (
    INSTALL,
    NAME,
    find_tool,
    finest_files,
    run_tool,
    streamed_command,
    tool_version,
)
from freqgs_plugin.io.spz import mark_antialiased

if TYPE_CHECKING:
    from rich.console import Console

PLY, SPZ, LEVELS = "splat.ply", "splat.spz", "levels"
MANIFEST = "manifest.json"
STREAMED = "sog/lod-meta.json"
BACK = "back.ply"
"""what splat-transform wrote, read back by it"""


@dataclass(frozen=True)
class Work:
    """Where a format writes, and what it adds to the manifest."""

    folder: Path
    console: "Console"
    notes: dict[str, Any] = field(default_factory=dict)


Write = Callable[[Source, ExportOptions, Work], list[Written]]
"""writes into the work's folder; the files that it returns are read back already"""


@dataclass(frozen=True)
class Format:
    """A row of the table of formats."""

    write: Write
    name: str
    """of the file or folder that is written; beside a file lies NAME.json, in a folder manifest.json"""
    check: Callable[[Source, ExportOptions], None] = check_plain
    """raises ValueError for what cannot be written, before work begins"""
    manifest: str = MANIFEST
    """of a folder, the file that tells what was lost"""


def write_as_ply(source: Source, options: ExportOptions, work: Work) -> list[Written]:
    """splat.ply: what any 3DGS viewer shows right."""
    begun = time.perf_counter()
    made = plain(source, options, work.console)
    return [_written(made, source, options, work.folder / PLY, begun)]


def write_as_spz(source: Source, options: ExportOptions, work: Work) -> list[Written]:
    """splat.spz by splat-transform, and read back by it."""
    begun = time.perf_counter()
    made = plain(source, options, work.console)
    _write(work.folder / "in.ply", made, source, options)
    run_tool("-w", "in.ply", SPZ, folder=work.folder)
    if made.mip:
        mark_antialiased(work.folder / SPZ)
    loss = _loss_of([work.folder / SPZ], made, source, options, work.folder)
    (work.folder / "in.ply").unlink()
    work.notes["tool"] = tool_version()
    return [Written(work.folder / SPZ, len(made.raw), loss, time.perf_counter() - begun, made.note)]


def check_spz(source: Source, options: ExportOptions) -> None:
    check_plain(source, options)
    if options.extra:
        raise ValueError(f"--extra {' '.join(options.extra)}: SPZ has no further properties; export ply.")
    if find_tool() is None:
        raise ValueError(f"--format spz needs {NAME} on the PATH, which is not installed: `{INSTALL}`.")


def write_as_levels(source: Source, options: ExportOptions, work: Work) -> list[Written]:
    """levels/: a complete PLY per prefix, one per level with its Gaussians as trained, and a streamed SOG."""
    folder = work.folder / LEVELS
    folder.mkdir()
    written, prefixes = [], []
    for level in range(1, source.levels + 1):
        begun, part = time.perf_counter(), source.up_to(level)
        if not len(part.raw):
            remedy = "choose another --crop" if options.crop is not None else "`freqgs trim` removes empty levels"
            raise ValueError(f"the prefix of level {level} holds no Gaussians; {remedy}.")
        made = plain(part, options, work.console, f"levels 1-{level}")
        written.append(_written(made, part, options, folder / f"prefix_{level}.ply", begun))
        prefixes.append(made)
    deltas = [_write_delta(source, options, level, folder) for level in range(1, source.levels + 1)]
    written += [delta for delta in deltas if delta is not None]
    names = [f"prefix_{level}.ply" for level in range(1, source.levels + 1)]
    sog, note = _write_streamed(source, options, prefixes, names, work)
    written += sog
    work.notes.update(
        levels=source.levels,
        signed_residuals=source.signed,
        viewer="mip" if prefixes[-1].mip else "classic",
        prefixes=names,
        deltas=[None if delta is None else delta.path.name for delta in deltas],
        streamed_sog=note,
    )
    return written


def check_levels(source: Source, options: ExportOptions) -> None:
    check_plain(source, options)
    if source.levels == 1:
        given = [f"--level {options.level}"] * (options.level is not None) + ["--crop"] * (options.crop is not None)
        why = f"{' and '.join(given)} leave one level" if given else "this scene has one level"
        raise ValueError(f"--format levels: {why}. Export it as ply; for clodsplat, at several --detail.")
    if options.extra:
        raise ValueError(f"--extra {' '.join(options.extra)}: files of levels have their level already; leave it out.")


FORMATS: dict[str, Format] = {
    "ply": Format(write_as_ply, PLY),
    "levels": Format(write_as_levels, LEVELS, check_levels),
    "spz": Format(write_as_spz, SPZ, check_spz),
    "stream": Format(write_as_stream, FOLDER, check_stream, "export.json"),
    "html": Format(write_as_html, PAGE, check_stream),
}
"""name on the command line -> how it is written"""


def move_to_file(source: Source, options: ExportOptions) -> Similarity:
    """From the scene's frame to the file's."""
    return source.frame.inverse() if options.frame == "dataset" else Similarity.identity()


def _written(made: Plain, source: Source, options: ExportOptions, path: Path, begun: float) -> Written:
    _write(path, made, source, options)
    loss = measure_loss(path, source, made.mip, move_to_file(source, options))
    return Written(path, len(made.raw), loss, time.perf_counter() - begun, made.note)


def _write(path: Path, made: Plain, source: Source, options: ExportOptions) -> None:
    raw = made.raw.moved(move_to_file(source, options))
    write_ply(path, raw, antialiased=made.mip, comments=[f"Frame: {options.frame}", f"Gaussians: {made.note}"])


def _write_delta(source: Source, options: ExportOptions, level: int, folder: Path) -> Written | None:
    """One level's Gaussians as they are trained; None where there are none."""
    begun, raw = time.perf_counter(), select(source.raw, source.gaussians.level == level)
    if not len(raw):
        return None
    signed = source.gaussians.signed_residuals and level > 1
    kind = "signed residuals: colours 2 max(SH + 0.5, 0) - 1" if signed else "plain colours"
    path = folder / f"level_{level}.ply"
    moved = replace(raw.moved(move_to_file(source, options)), decay=None)
    comments = [f"Frame: {options.frame}", f"Level {level} alone, {kind}"]
    write_ply(path, moved, antialiased=source.scene.antialiased, comments=comments)
    note = f"what level {level} adds, as trained" + (", signed: not for viewers" if signed else "")
    return Written(path, len(raw), None, time.perf_counter() - begun, note)


def _write_streamed(
    source: Source, options: ExportOptions, prefixes: list[Plain], names: list[str], work: Work
) -> tuple[list[Written], dict[str, Any]]:
    """The streamed SOG, and what the manifest says of it. A tool that fails or is interrupted costs nothing else."""
    folder = work.folder / LEVELS
    command = streamed_command(names, STREAMED)
    note: dict[str, Any] = {"command": [NAME, *command], "ran": False, "tool": "not asked"}
    by_hand = f"  {NAME} {' '.join(command)}"
    if find_tool() is None or not options.sog:
        work.console.print(f"For PlayCanvas viewers, after `{INSTALL}`, in {LEVELS}/:", soft_wrap=True)
        work.console.print(by_hand, soft_wrap=True, highlight=False)
        return [], note
    work.console.print(f"{NAME} makes a streamed SOG, which may take long; Ctrl-C leaves it out.", soft_wrap=True)
    begun = time.perf_counter()
    try:
        with work.console.status("clustering harmonics ..."):
            note["tool"] = tool_version()
            run_tool(*command, folder=folder)
            made = _streamed(source, options, prefixes, folder, begun)
    except (SplatFileError, KeyboardInterrupt) as error:
        shutil.rmtree((folder / STREAMED).parent, ignore_errors=True)
        (folder / BACK).unlink(missing_ok=True)
        note["failed"] = str(error) or "interrupted"
        work.console.print(
            f"[bold red]The streamed SOG is left out ({escape(note['failed'])}).[/] All else is written; in {LEVELS}/:",
            soft_wrap=True,
        )
        work.console.print(by_hand, soft_wrap=True, highlight=False)
        return [], note
    return made, {**note, "ran": True}


def _streamed(
    source: Source, options: ExportOptions, prefixes: list[Plain], folder: Path, begun: float
) -> list[Written]:
    """The finest level of detail of the SOG, which stands for the whole, read back by the tool that wrote it."""
    made = prefixes[-1]
    count = sum(len(prefix.raw) for prefix in prefixes)
    if not (folder / STREAMED).is_file():
        raise SplatFileError(f"{NAME} wrote no {STREAMED}; it is too old, update it with `{INSTALL}`.")
    loss = _loss_of(finest_files(folder / STREAMED), made, source, options, folder)
    note = f"streamed SOG of {len(prefixes)} levels of detail; loss of the finest one"
    return [Written((folder / STREAMED).parent, count, loss, time.perf_counter() - begun, note)]


def _loss_of(files: list[Path], made: Plain, source: Source, options: ExportOptions, folder: Path) -> Loss:
    """What files of splat-transform's lose, by the PLY that it makes of them."""
    run_tool("-w", *(file.resolve() for file in files), BACK, folder=folder)
    if not (folder / BACK).is_file():
        raise SplatFileError(f"{NAME} did not read back what it wrote; another version may (`{INSTALL}`).")
    loss = measure_loss(folder / BACK, source, made.mip, move_to_file(source, options))
    (folder / BACK).unlink()
    return loss
